# A simulated recording through the driver, from its output to its capture node: every picture arrives unchanged, and
# the trajectory matches the simulator's.
. /host/guest/camera

# At most two pictures a second, each a thirtieth of a second of motion, and each once the mapper has seen the one
# before it: emulation may be slow.
SEMIDENSE_INSTANCE="$rig" $user /host/camera_loop feed tum:/host/sim 2 2> /dev/null | v4l2-ctl -d "$out" --stream-out-mmap --stream-from=- > /dev/null 2>&1 &
feeder=$!
# One frame in five: emulation does not keep up with sixty a second.
control percentage_of_dropped_buffers=80
sleep 1
$user semidense --instance "$rig" run --source "v4l:platform-vivid.0" --rig "$work/rig.toml" --output "$work/run" --json \
    --set tracker.deadline_ms=2000 --set supervisor.watchdog_s=60 > "$work/summary.json" 2> "$work/log" &
job=$!
soon "run: frames flow" 60 flows
SEMIDENSE_INSTANCE="$rig" $user /host/camera_loop watch tum:/host/sim "$work/truth.txt" > "$work/watch.json" 2>&1 &
watcher=$!
soon "run: it tracks" 300 tracks
sleep 60
kill -INT "$watcher"
wait "$watcher"
finish
kill "$feeder"
cat "$work/watch.json"
expect "run ends in order" "exit code $CODE" test "$CODE" = 130
seen=$(jq -r '"\(.exact) of \(.exact + .unknown) frames, \(.repeated) of them repeated"' "$work/watch.json")
expect "every frame is a picture of the recording, pixel for pixel" "$seen" sh -c "jq -es '.[0] | .unknown == 0 and .exact > 100' $work/watch.json"
semidense evaluate "$work/run/trajectory.txt" "$work/truth.txt" --json > "$work/evaluation.json" 2>&1
cat "$work/evaluation.json"
seen=$(jq -r '"ATE \(.ate_rmse_m * 1000 | floor) mm, largest \(.ate_max_m * 1000 | floor) mm over \(.matched_poses) poses and \(.path_length_m) m"' "$work/evaluation.json")
expect "the trajectory is the simulator's" "$seen" sh -c "jq -es '.[0] | .matched_poses > 50 and .ate_rmse_m < 0.015 * .path_length_m' $work/evaluation.json"
mkdir -p /host/camera-run
cp -r "$work/run" "$work/log" "$work"/*.json "$work/truth.txt" /host/camera-run/
end_camera
