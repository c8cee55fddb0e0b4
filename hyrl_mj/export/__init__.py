"""Export: a hybrid controller as one ONNX file, or as a folder that needs NumPy alone.

The step is written once, in `templates/controller.py`. The methods of the task are traced operation by
operation: the NumPy form holds the operations as source, and the ONNX graph is the trace of the whole step.

No library exports NumPy code as it is:

- torch.onnx.export(dynamo=True) over torch's NumPy layer (torch 2.13, onnxscript 0.7) exports 48 of the 73
  functions in tests/test_export.py, and of four tasks only the observation of unit_circle. It refuses
  calls into MuJoCo, loses arrays of the task, turns Python numbers into float32, emits
  functions that onnxruntime lacks in float64 (arctan), and has no NumPy form.
- Arrays of ndonnx 0.23 and onnx-array-api 0.3 cannot be passed to NumPy's functions.
- onnxscript 0.7 alone compiles only calls of ONNX operators.
- jax2onnx 0.17 was not tried: it needs JAX, whose arrays cannot be assigned to.
"""

from hyrl_mj.export.forms import export, export_numpy, export_onnx, files_of

__all__ = ["export", "export_numpy", "export_onnx", "files_of"]
