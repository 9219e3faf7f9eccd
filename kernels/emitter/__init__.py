"""Light sources: one model a file."""
