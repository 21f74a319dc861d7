"""Files of the two formats: written, opened again and compared before they get their name."""

import io
import json
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.export import ExportedProgram

from deltas_nets import __version__
from deltas_nets.config import to_dict
from deltas_nets.errors import UserError
from deltas_nets.export.agreement import Agreement, Inputs, check_agreement
from deltas_nets.export.graph import (
    IMAGE_RANGE,
    INPUTS,
    MEANING,
    OUTPUTS,
    ExportConfig,
    parameters_sha256,
    trace,
    without_paths,
)
from deltas_nets.extras import check_extra
from deltas_nets.network.deltas import Deltas
from deltas_nets.outputs.atomic_files import plain, write_atomically

METADATA_FILE = "deltas.json"
"""Where a .pt2 file keeps what an .onnx file keeps as its metadata."""


def export_onnx(
    model: Deltas,
    out: Path | str,
    config: ExportConfig | None = None,
    *,
    weights: Mapping[str, str] | None = None,
) -> Agreement:
    """Write a network as ONNX, once onnxruntime has given the same depth as it.

    The file has the inputs and outputs of :class:`deltas_nets.export.graph.FixedDeltas` by name,
    and its metadata tell the network, weights, depth range and versions.

    Args:
        model: in eval mode, on any device.
        out: ends in .onnx.
        config: what is fixed; the default is 3 views of 240 x 320 and 512 points.
        weights: recorded as what identifies the weights' file.

    Raises:
        UserError: the extra "export" is not installed, the network cannot be expressed in ONNX,
            onnxruntime's depth differs, or the file cannot be written.
        ValueError: the network is in training mode.

    Example:
        >>> import tempfile
        >>> from deltas_nets import load_model
        >>> config = ExportConfig(num_views=2, num_points=64, image_size=(64, 96))
        >>> file = Path(tempfile.mkdtemp()) / "small.onnx"
        >>> export_onnx(load_model(), file, config).relative < 1e-3  # doctest: +SKIP
        True
        >>> import onnxruntime
        >>> session = onnxruntime.InferenceSession(file)  # doctest: +SKIP
        >>> [known.name for known in session.get_inputs()]  # doctest: +SKIP
        ['images', 'K', 'cam_from_world']
    """
    out, config = Path(out), config or ExportConfig()
    check_onnx(out)
    content = onnx_bytes(trace(model, config), metadata_of(model, config, weights), out)
    agreement = check_agreement(onnx_runner(content), model, config, runtime="onnxruntime", out=out)
    write_atomically(out, lambda file: file.write(content))
    return agreement


def export_program(
    model: Deltas,
    out: Path | str,
    config: ExportConfig | None = None,
    *,
    weights: Mapping[str, str] | None = None,
) -> Agreement:
    """Write a network for ``torch.export.load``, once that has given the same depth as it.

    ``torch.export.load(file).module()`` takes the inputs and returns the outputs of
    :class:`deltas_nets.export.graph.FixedDeltas`, on the device of the model, without this
    package. Metadata are in the extra file ``deltas.json``.

    Args:
        model: in eval mode, on the device where the file is to be used.
        out: ends in .pt2.
        config: what is fixed; the default is 3 views of 240 x 320 and 512 points.
        weights: recorded as what identifies the weights' file.

    Raises:
        UserError: the depth differs, or the file cannot be written.
        ValueError: the network is in training mode.
    """
    out, config = Path(out), config or ExportConfig()
    content = program_bytes(trace(model, config), metadata_of(model, config, weights))
    device = next(model.parameters()).device
    agreement = check_agreement(
        program_runner(content, device), model, config, runtime="torch.export", out=out
    )
    write_atomically(out, lambda file: file.write(content))
    return agreement


def check_onnx(out: Path) -> None:
    """Are the packages installed that ONNX needs?

    Raises:
        UserError: one is missing.
    """
    packages = ("onnx", "onnxscript", "onnxruntime")
    otherwise = "export a .pt2 file"
    check_extra("export", *packages, wanted_by="ONNX needs", where=out, otherwise=otherwise)


def metadata_of(
    model: Deltas, config: ExportConfig, weights: Mapping[str, str] | None = None
) -> dict[str, str]:
    """What a file tells about itself; each value is JSON."""
    known = {
        "network": to_dict(model.config),
        "export": to_dict(config),
        "depth_range": config.depth_range,
        "image_range": IMAGE_RANGE,
        "inputs": MEANING,
        "weights": {**(weights or {}), "parameters_sha256": parameters_sha256(model)},
        "versions": {"deltas-depth": __version__, "torch": torch.__version__},
    }
    return {name: json.dumps(plain(value)) for name, value in known.items()}


def onnx_bytes(program: ExportedProgram, metadata: Mapping[str, str], out: Path) -> bytes:
    """An ONNX file of a traced network.

    Raises:
        UserError: something in the network has no counterpart in ONNX.
    """
    from onnxscript.optimizer import optimize
    from torch.onnx import OnnxExporterError

    try:
        with _quiet():
            exported = torch.onnx.export(
                program,
                input_names=INPUTS,
                output_names=OUTPUTS,
                dynamo=True,
                optimize=False,
                verbose=False,
            )
            assert exported is not None
            # Torch's own call of it makes two rounds in twice the time, for 3 % fewer nodes.
            exported.model = optimize(exported.model, num_iterations=1, onnx_shape_inference=False)
    except OnnxExporterError as error:
        raise UserError(
            f"the network cannot be expressed in ONNX ({_last_cause(error)})",
            out,
            "export a .pt2 file",
        ) from error
    proto: Any = exported.model_proto
    for node in (*proto.graph.node, *(node for part in proto.functions for node in part.node)):
        del node.metadata_props[:]  # where our source files were
    for known in proto.graph.input:
        known.doc_string = MEANING[known.name]
    for name, value in metadata.items():
        proto.metadata_props.add(key=name, value=value)
    content: bytes = proto.SerializeToString()
    return content


def onnx_runner(content: bytes) -> "OnnxRunner":
    """The network of an ONNX file, on the CPU."""
    import onnxruntime  # type: ignore[import-untyped]

    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    return OnnxRunner(session)


class OnnxRunner:
    """Tensors in and out of an onnxruntime session."""

    def __init__(self, session: Any) -> None:
        self.session = session

    def __call__(self, inputs: Inputs) -> dict[str, Tensor]:
        """Outputs by name."""
        fed = {name: tensor.numpy() for name, tensor in zip(INPUTS, inputs, strict=True)}
        found = self.session.run(list(OUTPUTS), fed)
        pairs = zip(OUTPUTS, found, strict=True)
        return {name: torch.from_numpy(array) for name, array in pairs}


def program_bytes(program: ExportedProgram, metadata: Mapping[str, str]) -> bytes:
    """A file for ``torch.export.load`` of a traced network."""
    with _quiet():
        file = io.BytesIO()
        extra = {METADATA_FILE: json.dumps(metadata)}
        torch.export.save(without_paths(program), file, extra_files=extra)
    return file.getvalue()


class ProgramRunner:
    """Tensors in and out of an exported program on any device."""

    def __init__(self, module: torch.nn.Module, device: torch.device) -> None:
        self.module, self.device = module, device

    def __call__(self, inputs: Inputs) -> dict[str, Tensor]:
        """Outputs by name, on the CPU."""
        with torch.no_grad():
            found = self.module(*(tensor.to(self.device) for tensor in inputs))
        return {name: found[name].cpu() for name in OUTPUTS}


def program_runner(content: bytes, device: torch.device) -> ProgramRunner:
    """The network of a file of :func:`program_bytes`."""
    with _quiet():
        return ProgramRunner(torch.export.load(io.BytesIO(content)).module(), device)


def _last_cause(error: BaseException) -> str:
    """The error that an exception came from, in a line."""
    while error.__cause__ is not None:
        error = error.__cause__
    return " ".join(str(error).split())[:200]


@contextmanager
def _quiet() -> Iterator[None]:
    """The exporters talk about themselves: packages that we do not need, their own old calls."""
    logs = [logging.getLogger(name) for name in ("torch.onnx", "torch._export")]
    levels = [log.level for log in logs]
    for log in logs:
        log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for log, level in zip(logs, levels, strict=True):
            log.setLevel(level)
