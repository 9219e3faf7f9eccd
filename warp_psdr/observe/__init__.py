"""Measurements of real scenes: photographs, and scenes fitted to them with error bars."""
