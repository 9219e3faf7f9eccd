"""Device code of warp_psdr: one stage, model or method a file. Installed as ``warp_psdr.kernels``."""
