"""The C-arm and its image chain: poses, distortion, ray-casting, rendering."""
