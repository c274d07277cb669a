"""Lagrangian large-eddy simulation of turbulence, learned from direct numerical simulation, on MPI."""

__version__ = "0.2.0"
