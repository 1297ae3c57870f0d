"""Read datasets without training, and count their pairs of events."""

from pathlib import Path

from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.recording.dataset import EventDataset

for folder in ("scene", "scene_from_writer"):
    parser = NativeDataParserConfig(data=Path(folder)).setup()
    dataset = EventDataset(parser.get_dataparser_outputs("train"))
    print(len(dataset.pairs), "pairs;", len(dataset), "cameras to show;", dataset.scene.window)
    for split in ("val", "test"):
        print(split, [file.name for file in parser.get_dataparser_outputs(split).image_filenames])
