"""The policy alone as ONNX, for any runtime."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

OPSET = 17
"""Version of ONNX's operators."""


def to_onnx(arrays: Mapping[str, np.ndarray]) -> bytes:
    """A model with input `observation` (batch, n) and output `action` (batch, m).

    Args:
        arrays: As of `NumpyPolicy`.

    Raises:
        ImportError: onnx is not installed.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    layers = sum(name.startswith("W") for name in arrays)
    one = np.ones((), np.float32)
    given = dict(arrays) | {"-limit": -arrays["limit"], "-1": -one, "1": one}
    nodes = [
        helper.make_node("Sub", ["observation", "mean"], ["centred"]),
        helper.make_node("Div", ["centred", "std"], ["scaled"]),
        helper.make_node("Clip", ["scaled", "-limit", "limit"], ["x0"]),
    ]
    for k in range(layers):
        last = k == layers - 1
        nodes.append(helper.make_node("Gemm", [f"x{k}", f"W{k}", f"b{k}"], [f"y{k}"]))
        nodes.append(
            helper.make_node("Clip", [f"y{k}", "-1", "1"], ["action"])
            if last
            else helper.make_node("Tanh", [f"y{k}"], [f"x{k + 1}"])
        )
    sizes = len(arrays["mean"]), len(arrays[f"b{layers - 1}"])
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])
        for name, size in zip(("observation", "action"), sizes, strict=True)
    ]
    constants = [
        numpy_helper.from_array(np.asarray(x, np.float32), name)
        for name, x in given.items()
    ]
    graph = helper.make_graph(nodes, "policy", ends[:1], ends[1:], constants)
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8
    )
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()
