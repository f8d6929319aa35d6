"""Binary interface of kernels: one signature for emitting, loading and calling.

A kernel is one C function of addresses and whole numbers::

    void kernel(i64 P, double *theta, i64 stride, i64 *ints, double *floats, double *work,
                double *predictions, i64 predictions_stride, double *loss)

theta : K rows of `stride`: row = parameter, column = individual; P is a multiple of `NARROW_LANES`.
ints, floats : one experiment as packed by `sysid.simulation.experiment_arrays`.
work : scratch memory of the experiment's size; its initial contents do not matter.
predictions : null, or M_e rows of `predictions_stride`: simulated value at each measured time.
    If measurements correct the states, the deviations √S of the innovations follow.
loss : P sums; the kernel *adds* the experiment's loss, Σ w²e² for squares or
    Σ 2s²(√(1 + (we/s)²) − 1) for soft-l1. If measurements correct the states, Σ w²e²/S, and
    after `stride` of them Σ log S of the scored samples.

A kernel raises nothing: a diverging simulation leaves ``inf`` or ``nan`` in its own column.
"""

from llvmlite import ir

LANES = 16
"""W: individuals that are simulated together in one vector of doubles."""

NARROW_LANES = 8
"""W of the last block, if no more individuals are left; it takes two thirds of the time."""

KERNEL_NAME = "kernel"
"""Name of the kernel's function in its module."""

KERNEL_ARGUMENTS = (
    "P",
    "theta",
    "stride",
    "ints",
    "floats",
    "work",
    "predictions",
    "predictions_stride",
    "loss",
)
_INTEGER_ARGUMENTS = ("P", "stride", "predictions_stride")


def build_kernel_type() -> ir.FunctionType:
    """Build the LLVM type of a kernel; every argument is 64 bits wide."""
    number, address = ir.IntType(64), ir.PointerType()
    arguments = [number if name in _INTEGER_ARGUMENTS else address for name in KERNEL_ARGUMENTS]
    return ir.FunctionType(ir.VoidType(), arguments)
