"""Scattering models: value, sample, pdf and local factor of one model a file."""
