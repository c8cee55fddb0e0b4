"""Export: a hybrid controller as one ONNX file, or as a folder that needs NumPy alone.

The step is written once, in `templates/controller.py`. The methods of the task are traced operation by
operation: the NumPy form holds the operations as source, and the ONNX graph is the trace of the whole step.

No library exports NumPy code as it is: torch.onnx.export over torch's NumPy layer refuses calls into MuJoCo,
turns Python numbers into float32, and has no NumPy form; and arrays of ndonnx and onnx-array-api cannot be
passed to NumPy's functions.
"""

from hyrl_mj.export.forms import FORMS, export_numpy, export_onnx, files_of

__all__ = ["FORMS", "export_numpy", "export_onnx", "files_of"]
