"""Light that bounces: patches of bodies, and what they send to receivers."""
