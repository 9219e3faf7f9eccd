"""Factors that the methods of the interior term share: sweeps, sinks, velocities, and what moves."""
