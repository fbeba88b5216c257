"""The bundled lenses."""
