"""Reparameterised rays near the silhouettes of signed distance functions."""
