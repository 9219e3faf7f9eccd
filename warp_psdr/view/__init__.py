"""Scenes and gradient fields in 3D."""
