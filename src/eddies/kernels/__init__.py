"""Loops for the processor, compiled at installation: the only compiled code, behind a plain C interface."""
