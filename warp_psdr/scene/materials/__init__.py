"""Scattering models, textures and colours."""
