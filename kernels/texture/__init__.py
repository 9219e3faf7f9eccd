"""Textures: what varies over a surface or with direction."""
