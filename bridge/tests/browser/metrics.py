"""Reads /metrics with Prometheus' own parser and checks that the figures hang together."""
import math
import sys

from prometheus_client.openmetrics.parser import text_string_to_metric_families as openmetrics
from prometheus_client.parser import text_string_to_metric_families as plain

text = open(sys.argv[1]).read()
families = {family.name: family for family in openmetrics(text)}
assert len(list(plain(text))) >= len(families) > 30, len(families)
for name, family in families.items():
    assert family.documentation.endswith("."), name
    if family.type != "histogram":
        continue
    for process in {s.labels["process"] for s in family.samples}:
        of = [s for s in family.samples if s.labels["process"] == process]
        buckets = [(float(s.labels["le"]), s.value) for s in of if s.name.endswith("_bucket")]
        assert buckets == sorted(buckets) and math.isinf(buckets[-1][0]), name
        count = next(s.value for s in of if s.name.endswith("_count"))
        assert buckets[-1][1] == count, name
        if name == "semidense_latency_seconds" and process == "tracker":
            total = next(s.value for s in of if s.name.endswith("_sum"))
            assert count > 0 and 0 < total / count < 60, (total, count)
states = [s for s in families["semidense_process_state"].samples if s.labels["process"] == "tracker"]
assert sum(s.value for s in states) == 1, states
assert families["semidense_up"].samples[0].value == 1
assert families["semidense_poses"].type == "counter"
print(f"{len(families)} families")
