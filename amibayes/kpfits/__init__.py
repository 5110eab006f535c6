"""Kernel phases in KPFITS files: read, averaged over frames, audited, written."""

from amibayes.kpfits.file import KernelFile, is_kpfits, open_kpfits
from amibayes.kpfits.observables import kernel_observables
from amibayes.kpfits.write import write_kpfits, write_observables

__all__ = [
    "KernelFile",
    "is_kpfits",
    "kernel_observables",
    "open_kpfits",
    "write_kpfits",
    "write_observables",
]
