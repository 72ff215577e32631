"""Emitters: bodies whose surfaces send light of their own, as lamps do."""
