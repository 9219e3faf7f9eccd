"""Cameras and films: rays through a film position, pixel filters, and the way back from a point to the film."""
