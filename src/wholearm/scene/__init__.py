"""Data model of the mechanical system: object, fingers, friction, gravity."""
