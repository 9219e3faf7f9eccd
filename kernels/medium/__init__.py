"""Participating media: their records, how far light flies in them, and what of it they let pass."""
