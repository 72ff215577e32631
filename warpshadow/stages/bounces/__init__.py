"""Bounced light: patches of bodies, and their light at receivers."""
