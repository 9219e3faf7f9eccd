"""Files of scenes, meshes, materials and grids, and scenes as dictionaries and XML."""
