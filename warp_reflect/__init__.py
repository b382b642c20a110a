"""Accurate specular reflections on curved objects for OpenUSD stages, in NVIDIA Warp."""
