"""Methods of visibility, a file each, and the one that finds them by their names."""
