"""Estimators of the interior term: one method a file."""
