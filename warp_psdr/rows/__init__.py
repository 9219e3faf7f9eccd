"""Methods: what each keeps of a path, which kernels it runs, and what it cannot estimate; a file a method."""
