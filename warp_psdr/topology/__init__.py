"""The topology of a scene's meshes: edges, welded vertices, curves of intersection, patches, contacts."""
