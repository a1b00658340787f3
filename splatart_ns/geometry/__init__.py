"""Rotations, rigid motions, screws, cameras and spherical harmonics: pure torch functions over batches."""
