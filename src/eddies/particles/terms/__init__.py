"""Terms of the particle model. A scene or a program imports them by name."""
