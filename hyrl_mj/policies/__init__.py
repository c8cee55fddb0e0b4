"""Policies and controllers, which map a measurement to an input.

A policy is a network, a function or an ONNX model on the observation of a task; a controller adds a
mode. Agents that were trained elsewhere are read here, and nothing in their files is executed.
"""

from hyrl_mj.policies.algorithms import ALGORITHMS
from hyrl_mj.policies.controllers import (
    Controller,
    PolicyController,
    answer,
    as_controller,
    check_modes,
    is_memory,
    memory_at_start,
)
from hyrl_mj.policies.external import (
    FUNCTION,
    ONNX,
    STATISTICS,
    Agent,
    AnyPolicy,
    agent_at,
    load_agent,
    read_agent,
    reopen_agent,
)
from hyrl_mj.policies.functions import AgentWithMemory, from_callable
from hyrl_mj.policies.hybrid import ON_EDGE, HybridController
from hyrl_mj.policies.memoryless import Asked
from hyrl_mj.policies.mlp import (
    ACTIVATIONS,
    BLAS,
    TORCH_NAMES,
    MlpPolicy,
    ObservationPolicy,
    Policy,
    SampledPolicy,
)
from hyrl_mj.policies.preprocessing import (
    Normalization,
    PreprocessedPolicy,
    Preprocessing,
    as_function,
)
from hyrl_mj.policies.sb3_zip import infer_algorithm

__all__ = [
    "ACTIVATIONS",
    "ALGORITHMS",
    "BLAS",
    "FUNCTION",
    "ONNX",
    "ON_EDGE",
    "STATISTICS",
    "TORCH_NAMES",
    "Agent",
    "AgentWithMemory",
    "AnyPolicy",
    "Asked",
    "Controller",
    "HybridController",
    "MlpPolicy",
    "Normalization",
    "ObservationPolicy",
    "Policy",
    "PolicyController",
    "PreprocessedPolicy",
    "Preprocessing",
    "SampledPolicy",
    "agent_at",
    "algorithms",
    "answer",
    "as_controller",
    "as_function",
    "check_modes",
    "from_callable",
    "infer_algorithm",
    "is_memory",
    "load_agent",
    "memory_at_start",
    "read_agent",
    "reopen_agent",
]
