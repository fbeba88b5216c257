"""The cases, one module for a family."""
