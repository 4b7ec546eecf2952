"""Propagation paths: line of sight and mirror reflections by the image method, and what is made of path lists."""
