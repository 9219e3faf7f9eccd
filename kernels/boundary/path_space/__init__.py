"""Path-space boundary terms [ZMY*20, ZYZ21]: edges, creases and curves of intersection."""
