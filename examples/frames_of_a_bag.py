"""Write the frames of a bag and their times beside it, so that COLMAP can find their poses."""

from pathlib import Path

import numpy as np
from PIL import Image
from rosbags.highlevel import AnyReader

bag, topic = Path("recording/events.bag"), "/dvs/image_raw"
folder = bag.parent
with AnyReader([bag]) as reader, (folder / "images.txt").open("w") as file_list:
    connections = [connection for connection in reader.connections if connection.topic == topic]
    assert connections, f"no topic {topic}; the bag has {sorted(reader.topics)}"
    (folder / "images").mkdir()
    for index, (connection, _, raw) in enumerate(reader.messages(connections)):
        message = reader.deserialize(raw, connection.msgtype)
        assert message.encoding == "mono8", message.encoding
        rows = np.asarray(message.data).reshape(message.height, message.step)
        Image.fromarray(rows[:, : message.width]).save(folder / f"images/{index:06d}.png")
        stamp = message.header.stamp
        file_list.write(f"{stamp.sec}.{stamp.nanosec:09d} images/{index:06d}.png\n")
