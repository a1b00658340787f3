"""The commands that make or mend captures: `splatart synth`, `import`, `check`, `segment` and `labels`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from splatart_ns.capture.synthesis_options import SynthesisOptions
from splatart_ns.cli.common import choose_rasterizer, device
from splatart_ns.errors import InputError, printable


@dataclass
class Synth:
    """Render a capture with ground truth from any URDF."""

    robot: Annotated[Path, tyro.conf.Positional]
    """The URDF file, or the name of a built-in object (see `splatart demo`), or random-SEED[-PARTS] for a
    random one."""
    output_dir: Path
    """A folder that does not exist yet, or is empty."""
    options: Annotated[SynthesisOptions, tyro.conf.arg(name="")]
    """How it is rendered."""

    def run(self) -> None:
        from splatart_ns.capture.procedural import is_object_name, synthesize_object
        from splatart_ns.capture.synthesis import synthesize

        if is_object_name(str(self.robot)) and not self.robot.is_file():  # a folder may have its name
            synthesize_object(str(self.robot), self.output_dir, self.options)
        else:
            synthesize(self.robot, self.output_dir, self.options)
        print(f"Capture: {self.output_dir}")


@dataclass
class Import:
    """Make a capture of other tools' folders: labels of annotation tools, and results of ns-process-data as states."""

    sources: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folder of a capture; or of each state, with a transforms.json each, in the states' order."""
    output_dir: Path | None = None
    """Folder of the new capture; it does not exist yet, or is empty."""
    labels: Path | None = None
    """What the annotation tool exported: COCO segmentation, YOLO polygons with data.yaml, Labelme's JSON, or
    mask PNGs of ids or colours with _classes.csv or labelmap.txt; a file or a folder."""
    in_place: bool = False
    """Write the labels into the capture itself."""

    def run(self) -> None:
        from splatart_ns.capture import label_import

        only_labels = len(self.sources) == 1 and self.labels is not None
        if not self.sources or self.in_place == (self.output_dir is not None) or (self.in_place and not only_labels):
            mend = "or one capture, --labels and --in-place to write into the capture itself"
            raise InputError(f"Give --output-dir; {mend}.")
        if len(self.sources) == 1 and not only_labels:
            mend = "give --labels, or the folders of more states"
            raise InputError(f"{self.sources[0]} alone leaves nothing to import; {mend}.")
        if self.in_place:
            done = label_import.import_labels(self.sources[0], self.labels)
        else:
            done = label_import.import_capture(self.sources, self.output_dir, self.labels)
        if done is not None:
            print(f"Labels: {done.format}, {done.labelled} of {done.frames} frames; parts: {', '.join(done.parts)}")
            if done.unmatched:
                names = ", ".join(done.unmatched[:3]) + (", ..." if len(done.unmatched) > 3 else "")
                print(f"No frame has the name of {len(done.unmatched)} labelled images: {printable(names)}")
        print(f"Capture: {self.output_dir or self.sources[0]}")


@dataclass
class Check:
    """Say what is wrong with a capture, frame by frame, and how to mend it.

    The exit code is 2 if there are errors, so that it cannot be fitted, and 0 if there are none, or warnings alone.
    """

    capture: Annotated[Path, tyro.conf.Positional]
    """Folder of the capture."""
    suggest: int = 0
    """Name so many training frames that would help most to label next."""
    sheet: Path | None = None
    """Write a PNG of the frames with their labels, problems marked."""
    json: bool = False
    """Print JSON instead of text."""

    def run(self) -> None:
        from splatart_ns.capture.contact_sheet import write_contact_sheet
        from splatart_ns.capture.examination import as_json, as_text, examine

        if self.suggest < 0 or (self.sheet is not None and self.sheet.suffix.lower() != ".png"):
            mend = "give 0 or more frames, and a .png file"
            raise InputError(f"--suggest is {self.suggest} and --sheet {self.sheet}; {mend}.")
        examination = examine(self.capture, self.suggest)
        if self.sheet is not None and examination.capture is not None:
            write_contact_sheet(self.sheet, examination.capture, examination.problems, examination.suggested)
        print(as_json(examination) if self.json else as_text(examination))
        if examination.errors:
            raise SystemExit(2)


@dataclass
class Segment:
    """Make part labels from clicks and boxes with a promptable segmenter; take them by `splatart import --labels`.

    Needs the extra `sam`, and a segmenter on this machine: nothing is downloaded.
    """

    capture: Annotated[Path, tyro.conf.Positional]
    """Folder of the capture."""
    prompts: Path
    """JSON file {"STATE/FRAME": {"part": {"points": [[x, y]], "not": [[x, y]], "box": [x, y, x, y]}}}, pixels from the
    image's top left corner."""
    output: Path
    """A new folder for PNGs of part ids."""
    model: str | None = None
    """Folder of a SAM or SAM 2 for transformers, or its name in Hugging Face's cache."""

    def run(self) -> None:
        from splatart_ns.capture import segmenter
        from splatart_ns.capture.formats import load_capture

        loaded, sam = load_capture(self.capture), segmenter.Sam(self.model or segmenter.DEFAULT_MODEL, device())
        print(f"Labels: {segmenter.segment(loaded, self.prompts, self.output, sam)} frames in {self.output}")
        print(f"Take them: splatart import {self.capture} --labels {self.output} --output-dir LABELLED")


@dataclass
class Labels:
    """Render part labels for frames that have none, to be looked at and taken back by `splatart import --labels`."""

    bundle: Annotated[Path, tyro.conf.Positional]
    """Folder that `splatart fit` left."""
    data: Path
    """Folder of the capture that it was fitted to."""
    output: Path
    """A new folder for `labels`, PNGs of part ids, and `overlays`, pictures to look at."""

    def run(self) -> None:
        from splatart_ns.bundle import load_bundle
        from splatart_ns.bundle.rendered_labels import write_labels
        from splatart_ns.capture.formats import load_capture

        choose_rasterizer("auto")
        done = write_labels(load_bundle(self.bundle), load_capture(self.data), self.output, device())
        print(f"Labels: {len(done)} frames in {self.output / 'labels'}; look at {self.output / 'overlays'}, first at")
        for one in done[:5]:
            print(f"  {one.state}/{one.frame.name} ({one.doubtful:.0%} of the object's pixels left unlabelled)")
        print(f"Take them: splatart import {self.data} --labels {self.output / 'labels'} --output-dir LABELLED")
