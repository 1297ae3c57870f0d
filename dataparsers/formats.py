"""All dataset formats, and how the format of a folder is recognized."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.dataparsers import ecd, eds, enerf_esim, eventnerf, native, own_recording, paev3d, robust_enerf, tum_vie
from aenerf_ns.errors import DataError, reading
from aenerf_ns.files.output_paths import require_dataset
from aenerf_ns.recording.options import EventDataParserConfig

# All formats by registered name. Where a folder has several formats, the first one here is taken.
FORMATS: dict[str, EventDataParserConfig] = {
    "aenerf-data": native.NativeDataParserConfig(),
    "ecd-data": ecd.EcdDataParserConfig(),
    "robust-enerf-data": robust_enerf.RobustENeRFDataParserConfig(),
    "tum-vie-data": tum_vie.TumVieDataParserConfig(),
    "eds-data": eds.EdsDataParserConfig(),
    "enerf-esim-data": enerf_esim.ENeRFEsimDataParserConfig(),
    "eventnerf-data": eventnerf.EventNeRFDataParserConfig(),
    "paev3d-data": paev3d.PAEv3DDataParserConfig(),
    "event-recording-data": own_recording.OwnRecordingDataParserConfig(),
}
# The entry points in pyproject.toml name these variables. They have the order of FORMATS.
(
    aenerf_data,
    ecd_data,
    robust_enerf_data,
    tum_vie_data,
    eds_data,
    enerf_esim_data,
    eventnerf_data,
    paev3d_data,
    event_recording_data,
) = map(DataParserSpecification, FORMATS.values())


def recognize(data: Path) -> str:
    """Name the format of a dataset, judged by the names of its files.

    Raises:
        DataError: the folder does not exist, or has none of the formats, or one of its files is given for all.
    """
    with reading(data):
        name = _format_of(data)
        if name == "event-recording-data" and data.is_file() and _format_of(data.parent) not in (None, name):
            # The other files of the format say what an event file does not.
            problem = f"it belongs to a recording in the format {_format_of(data.parent)}"
            raise DataError(data, problem, "give the folder, or name a --format")
    if name is not None:
        return name
    require_dataset(data)
    known = "; ".join(f"{name}: {' with '.join(config.markers)}" for name, config in FORMATS.items())
    raise DataError(data, "no known format of recordings", f"looked for {known}")


def _format_of(data: Path) -> str | None:
    # Some formats are told by the names of the folders above.
    return next((name for name, config in FORMATS.items() if config.recognizes(data.absolute())), None)


@dataclass
class AutomaticDataParserConfig(DataParserConfig):
    """A recording in any known format. To set a format's options, name the format."""

    def setup(self, **kwargs: Any) -> Any:
        """Make the dataparser of the format of ``data``, with that format's default configuration.

        Raises:
            DataError: ``data`` does not exist, or has none of the formats.
        """
        name = recognize(Path(self.data))
        config = deepcopy(FORMATS[name])
        config.data = self.data
        CONSOLE.print(f"{self.data} is in the format {name}.", markup=False)
        parser = config.setup(**kwargs)
        parser.guessed_format = name
        return parser


event_data = DataParserSpecification(AutomaticDataParserConfig())
