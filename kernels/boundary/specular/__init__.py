"""Discontinuities seen through smooth mirrors and glass."""
