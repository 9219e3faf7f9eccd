"""Ray queries: a wide BVH traversed with SIMD on the CPU, and Warp's own mesh queries."""
