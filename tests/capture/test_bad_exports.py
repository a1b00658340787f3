"""Exports that cannot be imported."""

import json
import shutil
from pathlib import Path

import pytest
from label_exports import write_coco, write_colours, write_labelme, write_yolo

from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.label_import import import_capture
from splatart_ns.errors import InputError


def change_coco(change):
    def make(capture, folder):
        file = write_coco(capture, folder / "labels.json", "runs")
        content = json.loads(file.read_text())
        change(content)
        file.write_text(json.dumps(content))
        return file

    return make


def change_text(pattern, text):
    def make(capture, folder):
        (file, *_) = write_yolo(capture, folder).glob(pattern)
        file.write_text(text)
        return folder

    return make


def shape(**values):
    def make(capture, folder):
        file = min(write_labelme(capture, folder).iterdir())
        content = json.loads(file.read_text())
        content["shapes"][1].update(values)
        file.write_text(json.dumps(content))
        return folder

    return make


def zipped(capture, folder):
    write_coco(capture, folder / "labels.json", "runs")
    return Path(shutil.make_archive(folder, "zip", folder)).replace(folder / "labels.zip")


def cvat_xml(capture, folder):
    folder.mkdir()
    (folder / "annotations.xml").write_text("<annotations/>")
    return folder / "annotations.xml"


def one_text(capture, folder):
    return min(write_yolo(capture, folder).glob("train/labels/*.txt"))


def coloured(text, file="labelmap.txt"):
    def make(capture, folder):
        write_colours(capture, folder, "{}:{},{},{}::")
        (folder / "labelmap.txt").unlink()
        (folder / file).write_text(text)
        return folder

    return make


def segmentation(value):
    return change_coco(lambda e: e["annotations"][0].update(segmentation=value))


BAD_EXPORTS = {
    "resized": (change_coco(lambda e: e["images"][0].update(width=640)), "640x16 pixels; export it at the size"),
    "no name fits": (change_coco(lambda e: [i.update(file_name=f"a{i['id']}") for i in e["images"]]), "no frame"),
    "ambiguous": (change_coco(lambda e: e["images"][0].update(file_name="0000.png")), "'0000.png' may be state_00/"),
    "augmented": (change_coco(lambda e: e["images"][1].update(file_name="state_00_0000_png.rf.x.jpg")), "both label"),
    "box": (segmentation([]), "not boxes"),
    "two corners": (segmentation([[1, 2, 3, 4]]), "three corners"),
    "corner of text": (segmentation([[1, 2, 3, 4, "x", 5]]), "a coordinate of a segmentation"),
    "runs of another size": (segmentation({"size": [4, 4], "counts": [16]}), "is {'counts': [16]"),
    "runs too long": (segmentation({"size": [16, 16], "counts": [10**12]}), "do not fill"),
    "negative runs": (segmentation({"size": [16, 16], "counts": [300, -44]}), "do not fill"),
    "damaged runs": (segmentation({"size": [16, 16], "counts": "\u00e9"}), "damaged"),
    "runs cut off": (segmentation({"size": [16, 16], "counts": "o"}), "cut off"),
    "runs of endless numbers": (segmentation({"size": [16, 16], "counts": "o" * 10**5}), "damaged"),
    "two categories of one id": (
        change_coco(lambda e: e["categories"].append(dict(e["categories"][0]))),
        "there twice",
    ),
    "two images of one id": (change_coco(lambda e: e["images"].append(dict(e["images"][0]))), "id 1 of an image"),
    "unknown category": (change_coco(lambda e: e["annotations"][0].update(category_id=9)), "category_id 9"),
    "unknown image": (change_coco(lambda e: e["annotations"][0].update(image_id=99)), "image_id 99"),
    "no annotations": (change_coco(lambda e: e.update(annotations=[])), "labels no image"),
    "annotations of text": (change_coco(lambda e: e.update(annotations=["x"])), "annotations[0] is 'x'"),
    "YOLO boxes": (change_text("train/labels/*0003.txt", "0 0.5 0.5 0.1 0.1"), "a box is no polygon"),
    "YOLO pixels": (change_text("train/labels/*0003.txt", "0 5 5 9 9 5 9"), "divide them"),
    "YOLO words": (change_text("train/labels/*0003.txt", "door 0.5 0.5 0.1 0.1"), "line 1 is 'door"),
    "YOLO class": (change_text("train/labels/*0003.txt", "7 0.1 0.1 0.2 0.1 0.2 0.2"), "class 7, which none of"),
    "YOLO without NaN": (change_text("train/labels/*0003.txt", "0 nan 0.1 0.2 0.1 0.2 0.2"), "nan"),
    "YAML with code": (change_text("data.yaml", "names: !!python/object/apply:os.getcwd []"), "not YAML"),
    "YAML without names": (change_text("data.yaml", "names: 3"), "names is 3"),
    "Labelme box": (shape(shape_type="rectangle"), "state_00_0000.json: shape 1 (base) is a rectangle; draw it as"),
    "Labelme line": (shape(points=[[1, 2], [3, 4]]), "shape 1 (base) is [1, 2, 3, 4]; give the x and y of three"),
    "Labelme without points": (shape(points=None), "shape 1 (base) is None"),
    "Labelme without a name": (shape(label=""), "the label of shape 1 is ''; name the part"),
    "CVAT's own": (cvat_xml, "annotations.xml: there are no labels here; export them as COCO"),
    "one text": (one_text, "give the folder that holds data.yaml or classes.txt"),
    "zip": (zipped, "it is a zip; unpack it first"),
    "a colour without a name": (coloured("base:200,60,0::"), "0000.png: no class has the colour 0,0,255 of 32 pixels"),
    "a class without a colour": (
        coloured("base:200,60::\n"),
        "line 1 is ['base', '200', '60']; write a class name and",
    ),
    "a colour too bright": (
        coloured("a,0,0,256\nbase,9,9,9", "_classes.csv"),
        "line 1 is ['a', '0', '0', '256']",
    ),
    "a colour of two names": (coloured("a:0,0,1::\nb:0,0,1::\n"), "the colour 0,0,1 is 'a' and, in line 2, 'b'"),
    "nothing": (lambda c, folder: folder, "there are no labels here"),
}


@pytest.mark.parametrize("name", BAD_EXPORTS)
def test_what_cannot_be_imported_is_named_and_nothing_written(capture_folder, tmp_path, name):
    make, words = BAD_EXPORTS[name]
    export = make(load_capture(capture_folder), tmp_path / "export")
    with pytest.raises(InputError) as error:
        import_capture([capture_folder], tmp_path / "new", export)
    assert words in str(error.value) and str(tmp_path / "export") in str(error.value)
    assert {f.name for f in tmp_path.iterdir()} <= {"capture", "export"}
