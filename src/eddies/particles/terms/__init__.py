"""The terms of a particle model, a file each. Nothing here is imported before a scene or a program names it."""
