"""The differential radiative transfer equation: interior and boundary terms in one."""
