"""A rigid body's shadows on itself: traced once in its own frame, looked up under any rotation."""
