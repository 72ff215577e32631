"""How light bounces: which bodies send it, how often, and what receivers get of it. Imported where a scene asks."""
