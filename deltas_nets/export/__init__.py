"""The whole network as one file that needs neither this package nor, as ONNX, torch."""

from deltas_nets.export.agreement import Agreement
from deltas_nets.export.formats import export_onnx, export_program
from deltas_nets.export.graph import INPUTS, OUTPUTS, ExportConfig

__all__ = [
    "INPUTS",
    "OUTPUTS",
    "Agreement",
    "ExportConfig",
    "export_onnx",
    "export_program",
]
