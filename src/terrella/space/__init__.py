"""Geometry: cameras, reprojection, keyframes."""
