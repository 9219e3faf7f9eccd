"""Participating media and volumes."""
