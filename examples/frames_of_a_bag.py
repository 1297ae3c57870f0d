"""Write the frames of a bag and their times beside it, so that COLMAP can find their poses."""

from pathlib import Path

import numpy as np
from PIL import Image
from rosbags.highlevel import AnyReader

channels = {"mono8": (), "rgb8": (3,), "bgr8": (3,)}
bag, topic = Path("recording/events.bag"), "/dvs/image_raw"
folder = bag.parent
with AnyReader([bag]) as reader, (folder / "images.txt").open("w") as file_list:
    connections = [connection for connection in reader.connections if connection.topic == topic]
    assert connections, f"no topic {topic}; the bag has {sorted(reader.topics)}"
    (folder / "images").mkdir(exist_ok=True)
    for index, (connection, _, raw) in enumerate(reader.messages(connections)):
        message = reader.deserialize(raw, connection.msgtype)
        assert message.encoding in channels, f"{message.encoding} is none of {', '.join(channels)}"
        shape = (message.height, message.width, *channels[message.encoding])
        # Rows may be longer than their pixels.
        rows = np.asarray(message.data).reshape(message.height, message.step)[:, : np.prod(shape[1:])]
        pixels = rows.reshape(shape)[..., ::-1] if message.encoding == "bgr8" else rows.reshape(shape)
        Image.fromarray(pixels).save(folder / f"images/{index:06d}.png")
        stamp = message.header.stamp
        file_list.write(f"{stamp.sec}.{stamp.nanosec:09d} images/{index:06d}.png\n")
