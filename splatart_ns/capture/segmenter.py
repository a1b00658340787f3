"""Part labels from clicks and boxes, by a promptable segmenter (SAM and its kin) that the user has on the machine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatart_ns.capture.capture import Capture, CaptureError, Frame, State
from splatart_ns.capture.images import MAX_LABEL, read_image, read_sized, write_png
from splatart_ns.capture.mask_export import mask_paths, write_mask_classes
from splatart_ns.capture.values import parse_number, read_json, show
from splatart_ns.errors import InputError, first_line
from splatart_ns.files import new_folder

DEFAULT_MODEL = "facebook/sam2.1-hiera-small"


@dataclass(frozen=True)
class Prompt:
    """Where a part is in an image, in pixels from its top left corner."""

    inside: tuple[tuple[float, float], ...] = ()
    outside: tuple[tuple[float, float], ...] = ()
    box: tuple[float, float, float, float] | None = None
    """Left, top, right, bottom."""


Segmenter = Callable[[np.ndarray, Sequence[Prompt]], np.ndarray]
"""An image [H, W, 3] uint8 RGB and prompts to logits [len(prompts), H, W], above 0 inside."""


def segment(capture: Capture, prompts: Path, output: Path, segmenter: Segmenter) -> int:
    """Write part labels of the prompted frames as PNGs with `_classes.csv`, which `import_labels` reads: their number.

    `prompts` is a JSON file of frames, "STATE/FRAME" as `splatart check` names them, of parts, of prompts:
    `{"state_00/images/0001.png": {"lid": {"points": [[120, 80]], "not": [[60, 90]], "box": [100, 60, 200, 140]}}}`.
    A pixel that several parts claim belongs to the one that is surest of it; one that none claims is background.

    Raises:
        InputError: prompts that make no sense, an image that cannot be read, a folder in use.
    """
    frames = {f"{state.name}/{frame.name}": (state, frame) for state in capture.states for frame in state.frames}
    wanted = _read_prompts(prompts, frames)
    names = list(capture.parts.values())
    names += [name for parts in wanted.values() for name in parts if name not in names]
    names = list(dict.fromkeys(names))
    if same := {name.lower() for name in names if [other.lower() for other in names].count(name.lower()) > 1}:
        raise CaptureError(prompts, f"two parts are called {show(min(same))}", "spell it alike everywhere")
    if len(names) > MAX_LABEL:
        raise CaptureError(prompts, f"there are {len(names)} parts", f"name at most {MAX_LABEL}")
    paths = {state.name: mask_paths(state) for state in capture.states}
    with new_folder(output) as folder:
        for key, parts in wanted.items():
            state, frame = frames[key]
            image = read_sized(frame.image, read_image, frame.camera)[..., :3]
            logits = segmenter(image, list(parts.values()))
            ids = np.array([names.index(name) + 1 for name in parts], np.uint8)
            labels = np.where(logits.max(axis=0) > 0, ids[logits.argmax(axis=0)], np.uint8(0))
            write_png(folder / paths[state.name][frame.name], labels)
        write_mask_classes(folder / "_classes.csv", dict(enumerate(names, start=1)))
    return len(wanted)


def _read_prompts(file: Path, frames: dict[str, tuple[State, Frame]]) -> dict[str, dict[str, Prompt]]:
    wanted: dict[str, dict[str, Prompt]] = {}
    for key, parts in read_json(file).items():
        if key not in frames:
            raise CaptureError(file, f"{show(key)} is no frame", f"write it as {next(iter(frames))!r}")
        if not isinstance(parts, dict) or not parts:
            raise CaptureError(file, f"{key} is {show(parts)}", 'write {"part": {"points": [[x, y]]}}')
        camera = frames[key][1].camera
        wanted[key] = {}
        for name, value in parts.items():
            if not name.strip() or "," in name or not name.isprintable():
                raise CaptureError(file, f"a part of {key} is called {show(name)}", "give it a name without commas")
            wanted[key][name] = _parse_prompt(file, f"{name} of {key}", value, camera.width, camera.height)
    if not wanted:
        raise CaptureError(file, "there are no prompts", "give some frames' parts clicks or boxes")
    return wanted


def _parse_prompt(file: Path, owner: str, value: Any, width: int, height: int) -> Prompt:
    if not isinstance(value, dict) or not set(value) <= {"points", "not", "box"}:
        mend = 'write {"points": [[x, y]]}, with "not" and "box" as needed'
        raise CaptureError(file, f"{owner} is {show(value)}", mend)

    def numbers(key: str, found: Any, count: int) -> tuple[float, ...]:
        if not isinstance(found, list) or len(found) != count:
            raise CaptureError(file, f"{key} of {owner} holds {show(found)}", f"write {count} numbers of pixels")
        parsed = tuple(parse_number(file, f"{key} of {owner}", x) for x in found)
        if any(not 0 <= x <= size for x, size in zip(parsed, (width, height) * 2, strict=False)):
            raise CaptureError(file, f"{key} of {owner} is {show(found)}", f"stay within {width}x{height} pixels")
        return parsed

    def points(key: str) -> tuple[tuple[float, ...], ...]:
        found = value.get(key, [])
        if not isinstance(found, list):
            raise CaptureError(file, f"{key} of {owner} is {show(found)}", "write [[x, y], ...]")
        return tuple(numbers(key, point, 2) for point in found)

    box = numbers("box", value["box"], 4) if value.get("box") is not None else None
    if box is not None and (box[0] >= box[2] or box[1] >= box[3]):
        raise CaptureError(file, f"box of {owner} is {show(value['box'])}", "write left, top, right, bottom")
    prompt = Prompt(points("points"), points("not"), box)
    if not prompt.inside and box is None:
        raise CaptureError(file, f"{owner} has no click", "give a point inside it, or a box")
    return prompt


class Sam:
    """A model of `transformers` for mask generation: SAM, SAM 2, EdgeTAM, ...; nothing is downloaded.

    Args:
        model: Folder of the model, or the name under which Hugging Face's cache has it.
        device: Where it runs.

    Raises:
        InputError: transformers is not installed, or there is no such model here.
    """

    def __init__(self, model: str = DEFAULT_MODEL, device: str = "cpu") -> None:
        try:
            from transformers import AutoModelForMaskGeneration, AutoProcessor
        except ImportError:
            raise InputError(
                "Segmenting needs transformers; install it with `pip install 'splatart-ns[sam]'`."
            ) from None
        options = {"local_files_only": True, "trust_remote_code": False}
        try:
            self._processor = AutoProcessor.from_pretrained(model, **options)
            self._model = AutoModelForMaskGeneration.from_pretrained(model, use_safetensors=True, **options)
        except (OSError, ValueError, KeyError) as error:
            raise InputError(
                f"There is no segmenter {model!r} on this machine ({first_line(error)[:150]}); download one with "
                f"`hf download {DEFAULT_MODEL}`, or give --model the folder of one, with its safetensors."
            ) from None
        self._model.to(device).eval()
        self._device = device

    def __call__(self, image: np.ndarray, prompts: Sequence[Prompt]) -> np.ndarray:
        """Logits [len(prompts), H, W] of an image [H, W, 3], of each prompt's masks those that the model rates best."""
        import torch

        embeddings, logits = None, []
        with torch.no_grad():
            for prompt in prompts:
                clicks = [*prompt.inside, *prompt.outside]
                asked: dict[str, Any] = {}
                if clicks:
                    asked["input_points"] = [[[list(point) for point in clicks]]]
                    asked["input_labels"] = [[[1] * len(prompt.inside) + [0] * len(prompt.outside)]]
                if prompt.box is not None:
                    asked["input_boxes"] = [[list(prompt.box)]]
                inputs = self._processor(images=image, return_tensors="pt", **asked).to(self._device)
                pixels = inputs.pop("pixel_values")
                if embeddings is None:
                    embeddings = self._model.get_image_embeddings(pixels)
                sizes = [inputs.pop(name) for name in ("original_sizes", "reshaped_input_sizes") if name in inputs]
                output = self._model(image_embeddings=embeddings, multimask_output=True, **inputs)
                best = int(output.iou_scores[0, 0].argmax())
                masks = self._processor.post_process_masks(output.pred_masks.cpu(), *sizes, binarize=False)
                logits.append(masks[0][0, best].float().numpy())
        return np.stack(logits)
