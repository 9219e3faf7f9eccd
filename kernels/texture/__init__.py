"""Textures: values that vary over a surface or with direction."""
