"""Counts the messages of a recording without end, as far as it goes."""

import sys
from collections import Counter

from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader

counts = Counter()
with open(sys.argv[1], "rb") as file:
    try:
        for schema, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
            counts[channel.topic] += 1
    except McapError as error:
        print(f"ends early: {error}", file=sys.stderr)
print(counts["/left/image_rect/compressed"])
