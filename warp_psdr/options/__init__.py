"""Options that users make: frozen dataclasses of integrators and of their methods."""
