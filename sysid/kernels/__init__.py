"""Kernels: LLVM code for the vectorised simulation and loss of a population."""
