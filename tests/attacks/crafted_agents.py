"""Agents of a stranger as zips of SB3 and as safetensors: each must be refused, in one sentence."""

import io
import json
import pickle
import struct
import zipfile
import zlib
from base64 import b64encode
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import save

from attacks import MARKER
from hyrl_mj.files import artifacts

ESCAPE = "\x1b[31mred"
MANY = 2**29  # bytes of a bomb


class Payload:
    """What must never be unpickled: it leaves a file behind."""

    def __reduce__(self) -> tuple[Any, ...]:
        return open, (MARKER, "w")


def network() -> dict[str, torch.Tensor]:
    """Returns the tensors of a PPO agent on the unit circle."""
    rng = np.random.default_rng(0)
    shapes = {
        "log_std": (1,),
        "mlp_extractor.policy_net.0.weight": (8, 2),
        "mlp_extractor.policy_net.0.bias": (8,),
        "mlp_extractor.value_net.0.weight": (8, 2),
        "mlp_extractor.value_net.0.bias": (8,),
        "action_net.weight": (1, 8),
        "action_net.bias": (1,),
        "value_net.weight": (1, 8),
        "value_net.bias": (1,),
    }
    return {
        n: torch.from_numpy(rng.normal(size=shape).astype(np.float32))
        for n, shape in shapes.items()
    }


def honest(folder: Path) -> list[str]:
    """Writes agents that can be used, and returns their names."""
    from attacks.crafted_models import honest_model

    return [write_zip(folder), write_safetensors(folder), honest_model(folder)]


# ---- zips


def saved(content: object, **options: Any) -> bytes:
    """Returns what torch.save writes."""
    buffer = io.BytesIO()
    torch.save(content, buffer, **options)
    return buffer.getvalue()


def write_zip(folder: Path, policy: object = None, data: object = None, **members: bytes) -> str:
    """Writes an agent's zip: a network or the bytes of policy.pth, metadata, and further members."""
    pth = policy if isinstance(policy, bytes) else saved(policy or network())
    with zipfile.ZipFile(folder / "agent.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("policy.pth", pth)
        file.writestr(
            "data",
            data
            if isinstance(data, str)
            else json.dumps({"num_timesteps": 0, **(data or {"clip_range": 0.2})}),
        )
        for name, content in members.items():
            file.writestr(name.replace("__", "."), content)
    return "agent.zip"


def changed(**tensors: Any) -> dict[str, Any]:
    """Returns the network with some tensors changed; None removes one."""
    named = {name.replace("__", "."): tensor for name, tensor in tensors.items()}
    whole: dict[str, Any] = {**network(), **named}
    return {name: tensor for name, tensor in whole.items() if tensor is not None}


def pickled(folder: Path, protocol: int) -> str:
    return write_zip(folder, pickle.dumps(Payload(), protocol))


def pickled_in_torch(folder: Path, **options: Any) -> str:
    return write_zip(folder, saved({**network(), "payload": Payload()}, **options))


def pickled_metadata(folder: Path) -> str:
    """The metadata that SB3 itself would unpickle; the weights are of no agent for this task."""
    serialized = b64encode(pickle.dumps(Payload())).decode()
    kinds = ("policy_class", "observation_space", "action_space", "lr_schedule", "policy_kwargs")
    data = {kind: {":type:": "x", ":serialized:": serialized} for kind in kinds}
    payload = saved(Payload())
    return write_zip(
        folder, changed(action_net__weight=torch.zeros(3, 8)), data,
        pytorch_variables__pth=payload, policy__optimizer__pth=payload,
    )  # fmt: skip


def lying(folder: Path, member: str) -> str:
    """A member that unpacks to far more than the directory of the zip says."""
    with zipfile.ZipFile(folder / "agent.zip", "w", zipfile.ZIP_DEFLATED) as file:
        for name in {"policy.pth", "data"} - {member}:
            file.writestr(name, b"{}")
        zeros(file, member)
    content = (folder / "agent.zip").read_bytes()
    content = content.replace(struct.pack("<L", MANY), struct.pack("<L", 1000))
    (folder / "agent.zip").write_bytes(content)
    return "agent.zip"


def bomb(folder: Path, compression: int) -> str:
    with zipfile.ZipFile(folder / "agent.zip", "w", compression) as file:
        zeros(file, "policy.pth")
    return "agent.zip"


def zeros(file: zipfile.ZipFile, name: str) -> None:
    """Writes a member of zeros, without having them all in memory."""
    with file.open(name, "w") as member:
        for _ in range(MANY // 2**22):
            member.write(bytes(2**22))


def crowded(folder: Path) -> str:
    """A zip of a hundred thousand members, and no policy."""
    with zipfile.ZipFile(folder / "agent.zip", "w") as file:
        for number in range(100_000):
            file.writestr(f"{number}", b"")
    return "agent.zip"


def marked(folder: Path, flag: int, method: int) -> str:
    """A zip whose members say that they are encrypted, or packed in a way that nobody knows."""
    write_zip(folder)
    content = bytearray((folder / "agent.zip").read_bytes())
    for signature, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        place = content.find(signature)
        while place >= 0:
            content[place + at] |= flag
            if method:
                content[place + at + 2] = method
            place = content.find(signature, place + 4)
    (folder / "agent.zip").write_bytes(content)
    return "agent.zip"


def vast(folder: Path, **about: int) -> str:
    """A zip64 whose directory says of policy.pth what 32 bits cannot: its sizes, or where it begins."""
    write_zip(folder, bytes(2**20))
    with zipfile.ZipFile(folder / "agent.zip", "a") as file:
        file.writestr("more", b"")  # so that the directory is written again
        for name, number in about.items():
            setattr(file.getinfo("policy.pth"), name, number)
    return "agent.zip"


def overlapping(names: Sequence[str], content: bytes) -> bytes:
    """Returns a zip whose members all unpack the same bytes: what is between them counts as their heads."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    packed = packer.compress(content) + packer.flush()
    about = 20, 0, zipfile.ZIP_DEFLATED, 0, 33, zlib.crc32(content), len(packed), len(content)
    heads, directory, at = b"", b"", 0
    for name in reversed(names):
        head = struct.pack("<4s5H3L2H", b"PK\3\4", *about, len(name), len(heads))
        heads = head + name.encode() + heads
    for name in names:
        head = struct.pack("<4sH5H3L5H2L", b"PK\1\2", 20, *about, len(name), 0, 0, 0, 0, 0, at)
        directory += head + name.encode()
        at += 30 + len(name)
    end = (0, 0, len(names), len(names), len(directory), len(heads) + len(packed), 0)
    return heads + packed + directory + struct.pack("<4s4H2LH", b"PK\5\6", *end)


def cut(folder: Path) -> str:
    write_zip(folder)
    path = folder / "agent.zip"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return "agent.zip"


def deep_layers(folder: Path) -> str:
    """Twenty thousand layers, each of which fits the next but for the last."""
    layers = {
        f"mlp_extractor.policy_net.{2 * k}.{part}": torch.zeros(shape)
        for k in range(1, 20_000)
        for part, shape in (("weight", (8, 8)), ("bias", (8,)))
    }
    return write_zip(folder, {**network(), **layers, "action_net.weight": torch.zeros(1, 9)})


def scripted(folder: Path) -> str:
    """A TorchScript archive in place of the tensors: it is code."""
    buffer = io.BytesIO()
    torch.jit.save(torch.jit.script(torch.nn.Linear(2, 1)), buffer)
    return write_zip(folder, buffer.getvalue())


def garbage(folder: Path, name: str, content: bytes) -> str:
    (folder / name).write_bytes(content)
    return name


def sparse(folder: Path, name: str) -> str:
    """A file of 4 GB that takes no room on the disk."""
    with (folder / name).open("wb") as file:
        file.truncate(2**32)
    return name


# ---- safetensors


def write_safetensors(
    folder: Path, content: bytes | None = None, about: dict[str, Any] | None = None
) -> str:
    """Writes a policy with its description."""
    whole = {"task": "unit_circle", "algorithm": "ppo", "activation": "tanh", **(about or {})}
    artifacts.write_json(folder / "agent.json", whole, "policy")
    tensors = {name: tensor.numpy() for name, tensor in network().items()}
    (folder / "agent.safetensors").write_bytes(save(tensors) if content is None else content)
    return "agent.safetensors"


def header(content: object, size: int | None = None, rest: bytes = b"") -> bytes:
    """Returns a safetensors file with a header of one's own."""
    text = content if isinstance(content, bytes) else json.dumps(content).encode()
    return struct.pack("<Q", len(text) if size is None else size) + text + rest


def tensors_of(*places: tuple[list[int], list[int]]) -> bytes:
    """Returns a file of tensors with these shapes at these places, of 64 bytes of numbers."""
    entries = [{"dtype": "F32", "shape": shape, "data_offsets": ends} for shape, ends in places]
    return header(
        {f"{number}.weight": entry for number, entry in enumerate(entries)}, rest=bytes(64)
    )


def naming(folder: Path, task: str) -> str:
    """A description that names a Python file, or a task that nobody knows."""
    (folder / "evil.py").write_text(f"open({str(folder / MARKER)!r}, 'w').close()\n")
    return write_safetensors(folder, about={"task": task.format(folder=folder)})


def described(folder: Path, text: str) -> str:
    write_safetensors(folder)
    (folder / "agent.json").write_text(text, encoding="utf-8")
    return "agent.safetensors"


NAN = torch.full((1, 8), float("nan"))
FILES: dict[str, Callable[[Path], str]] = {
    "zip, policy.pth is a pickle": partial(pickled, protocol=2),
    "zip, policy.pth is a pickle of protocol 0": partial(pickled, protocol=0),
    "zip, a payload among the tensors": pickled_in_torch,
    "zip, a payload in torch's old format": partial(
        pickled_in_torch, _use_new_zipfile_serialization=False
    ),
    "zip, payloads in the metadata and beside the weights": pickled_metadata,
    "zip, TorchScript": scripted,
    "zip, policy.pth larger than its directory says": partial(lying, member="policy.pth"),
    "zip, data larger than its directory says": partial(lying, member="data"),
    "zip, a bomb": partial(bomb, compression=zipfile.ZIP_DEFLATED),
    "zip, a bomb packed by LZMA": partial(bomb, compression=zipfile.ZIP_LZMA),
    "zip, 100,000 members": crowded,
    "zip, encrypted": partial(marked, flag=1, method=0),
    "zip, of an unknown compression": partial(marked, flag=0, method=77),
    "zip, cut in half": cut,
    "zip64, a policy.pth of 2**60 bytes": partial(vast, file_size=2**60, compress_size=2**60),
    "zip64, a policy.pth packed in 2**60 bytes": partial(vast, compress_size=2**60),
    "zip64, a policy.pth at 2**62": partial(vast, header_offset=2**62),
    "zip, members that overlap": lambda folder: garbage(
        folder, "agent.zip", overlapping(("policy.pth", "data", *map(str, range(1_000))), bytes(2**24))
    ),
    "zip, tensors whose zip has members that overlap": lambda folder: write_zip(
        folder, overlapping(("a/data.pkl", *(f"a/data/{n}" for n in range(1_000))), bytes(2**24))
    ),
    "zip, 20,000 layers": deep_layers,
    "zip, a list of tensors": partial(write_zip, policy=[torch.zeros(2)]),
    "zip, a strided tensor of 2**40 numbers": lambda folder: write_zip(
        folder, changed(action_net__weight=torch.zeros(1, 1).expand(2**20, 2**20))
    ),
    "zip, a network without numbers": lambda folder: write_zip(
        folder, changed(action_net__weight=torch.zeros(0, 0), action_net__bias=torch.zeros(0))
    ),
    "zip, a weight in three dimensions": lambda folder: write_zip(
        folder, changed(action_net__weight=torch.zeros(1, 8, 1))
    ),
    "zip, NaN": lambda folder: write_zip(folder, changed(action_net__weight=NAN)),
    "zip, complex weights": lambda folder: write_zip(
        folder, changed(action_net__weight=torch.zeros(1, 8, dtype=torch.complex64))
    ),
    "zip, a name that colours the terminal": lambda folder: write_zip(
        folder, {f"{ESCAPE}.weight": torch.zeros(1, 2)}
    ),
    "zip, trained under VecNormalize": lambda folder: write_zip(
        folder,
        data={
            "num_timesteps": 1_000, "clip_range": 0.2,
            "_last_original_obs": {":type:": "ndarray", ":serialized:": "gA=="},
        },
    ),
    "zip, CrossQ": lambda folder: write_zip(
        folder,
        {
            "actor.latent_pi.0.ra_mean": torch.zeros(2),
            "actor.latent_pi.1.weight": torch.zeros(8, 2),
            "actor.latent_pi.1.bias": torch.zeros(8),
            "actor.mu.weight": torch.zeros(1, 8),
            "actor.mu.bias": torch.zeros(1),
            "actor.log_std.weight": torch.zeros(1, 8),
            "actor.log_std.bias": torch.zeros(1),
        },
    ),
    "zip, deep metadata": lambda folder: write_zip(folder, data="[" * 10**5 + "]" * 10**5),
    "zip, metadata of 10**5 digits": lambda folder: write_zip(folder, data=f'{{"a": {"9" * 10**5}}}'),
    "zip, an activation that colours the terminal": lambda folder: write_zip(
        folder, data={"policy_kwargs": {":type:": "dict", "activation_fn": ESCAPE}}
    ),
    "zip, empty": lambda folder: garbage(folder, "agent.zip", b""),
    "zip, 4 GB of nothing": lambda folder: sparse(folder, "agent.zip"),
    "safetensors, 4 GB of nothing": lambda folder: (
        write_safetensors(folder), sparse(folder, "agent.safetensors")
    )[1],
    "safetensors, whose description names a Python file": partial(naming, task="{folder}/evil.py"),
    "safetensors, whose description names a file near by": partial(naming, task="./evil.py"),
    "safetensors, whose algorithm is a module": lambda folder: write_safetensors(
        folder, about={"algorithm": "os:system"}
    ),
    "safetensors, whose activation is a list": lambda folder: write_safetensors(
        folder, about={"activation": ["tanh"]}
    ),
    "safetensors, whose task is a dictionary": lambda folder: write_safetensors(
        folder, about={"task": {"a": 1}}
    ),
    "safetensors, a header of 2**60 bytes": lambda folder: write_safetensors(
        folder, header(b"{}", size=2**60)
    ),
    "safetensors, a tensor of 2**62 numbers": lambda folder: write_safetensors(
        folder, tensors_of(([2**31, 2**31], [0, 64]))
    ),
    "safetensors, tensors that overlap": lambda folder: write_safetensors(
        folder, tensors_of(*[([16], [0, 64])] * 10_000)
    ),
    "safetensors, tensors that overlap in part": lambda folder: write_safetensors(
        folder, tensors_of(([12], [0, 48]), ([12], [16, 64]))
    ),
    "safetensors, a gap between tensors": lambda folder: write_safetensors(
        folder, tensors_of(([4], [0, 16]), ([4], [48, 64]))
    ),
    "safetensors, a deep header": lambda folder: write_safetensors(
        folder, header(b"[" * 10**5 + b"]" * 10**5)
    ),
    "safetensors, a deep description": lambda folder: described(folder, "[" * 10**5),
    "safetensors, a description with half a character": lambda folder: described(
        folder, '{"kind": "policy", "version": 2, "task": "\\ud800"}'
    ),
}  # fmt: skip
