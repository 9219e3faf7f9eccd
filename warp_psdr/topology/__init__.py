"""What the meshes of a scene are made of: edges, welded vertices, curves of intersection, patches, contacts."""
