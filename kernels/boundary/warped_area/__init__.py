"""Warped-area sampling: rays that move with the silhouettes of meshes."""
