"""The policy as an ONNX graph: from `obs` and `eta` to `action`, in double precision."""

from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from pup.policy.bundle import CLIP, FLOOR, Weights, layers
from pup.policy.shape import PolicyShape

OPSET = 17
IR_VERSION = 8
"""Old enough for the runtimes of small computers."""


def onnx_graph(shape: PolicyShape, weights: Weights) -> bytes:
    """Build the graph.

    Args:
      shape: of the policy.
      weights: by the names of ProjectedPolicy.

    Returns:
      The model's bytes. Inputs `obs`, float64 (n, n_entries), as measured, and `eta`, float64 (n,
      n_eta); outputs `action`, float64 (n, n_joints), the mean
      of the bins, and `logits`, float64 (n, n_bins, n_joints).
    """
    constants: list[Any] = []
    nodes: list[Any] = []

    def constant(name: str, value: Any) -> str:
        constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def node(kind: str, inputs: list[str], output: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    known = {name: np.asarray(value, dtype=np.float64) for name, value in weights.items()}
    scale = np.sqrt(np.maximum(known["observations.variance"], FLOOR))
    centred = node("Sub", ["obs", constant("mean", known["observations.mean"])], "centred")
    scaled = node("Div", [centred, constant("scale", scale)], "scaled")
    ends = [constant("low", np.float64(-CLIP)), constant("high", np.float64(CLIP))]
    here = node("Clip", [scaled, *ends], "clipped")
    if shape.eta:
        here = node("Concat", [here, "eta"], "inputs", axis=1)
    network = layers(known, "actor")
    for i, (weight, bias) in enumerate(network):
        told = [here, constant(f"weight{i}", weight), constant(f"bias{i}", bias)]
        here = node("Gemm", told, f"linear{i}", transB=1)
        if i < len(network) - 1:
            here = node("Tanh", [here], f"hidden{i}")
    size = constant("size", np.array([-1, shape.bins, shape.joints], dtype=np.int64))
    node("Reshape", [here, size], "logits")
    node("Softmax", ["logits"], "weights", axis=1)
    order = constant("order", np.arange(float(shape.bins))[:, None])
    weighed = node("Mul", ["weights", order], "weighed")
    node("ReduceSum", [weighed, constant("bins", np.array([1]))], "action", keepdims=0)
    double = TensorProto.DOUBLE
    graph = helper.make_graph(
        nodes,
        "policy",
        [
            helper.make_tensor_value_info("obs", double, ["n", shape.proprioception]),
            helper.make_tensor_value_info("eta", double, ["n", shape.eta]),
        ],
        [
            helper.make_tensor_value_info("action", double, ["n", shape.joints]),
            helper.make_tensor_value_info("logits", double, ["n", shape.bins, shape.joints]),
        ],
        constants,
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION
    )
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())
