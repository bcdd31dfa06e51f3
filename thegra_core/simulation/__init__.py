"""Exact synthetic recordings: a textured scene, a smooth path, a renderer with depth, and a bag with ground truth."""
