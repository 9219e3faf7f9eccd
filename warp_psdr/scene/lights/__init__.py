"""Light sources and the sky."""
