"""Views: geometries seen by cameras, and the images that are made of them."""
