"""`Model` → LLVM: vectorised simulation and loss of a population."""
