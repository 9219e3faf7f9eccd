"""Photographs, and scenes fitted to them."""
