"""Phase functions, one a file, and their dispatch."""
