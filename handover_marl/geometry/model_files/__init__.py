"""Model files: URDF trees of shapes, OBJ files and their meshes."""
