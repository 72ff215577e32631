"""Ray-traced light: of stills, and of the path-traced reference."""
