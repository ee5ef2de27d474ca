# A camera of a real driver (vivid): listed, opened, busy, forbidden, damaged, unplugged; and a simulated recording
# through its output-to-capture loop, whose trajectory is compared with the simulator's.
. /host/guest/lib
rig=camera
camera=/dev/video0
out=/dev/video1
work=/tmp/camera
mkdir -p "$work"
chmod 777 "$work"

control() { v4l2-ctl -d "$camera" -c "$1" > /dev/null 2>&1; }
# The process itself in the background has to be killed, not who has become its user.
user="setpriv --reuid semidense --regid semidense --init-groups"
as_user() { $user semidense --instance "$rig" "$@"; }
# count FIELD: a counter of the capture process.
count() { status ".capture.$1 // 0"; }
counts() { [ "$(count "$1")" -ge "$2" ]; } # FIELD LEAST
capture_is() { status '.capture.state' | grep -qx "$1"; }
flows() { status '.capture | select(.state == "running" and .rate_hz > 0) | .frames' | grep -q .; }
says() { grep -q "$1" "$work/log"; }
doctor() { as_user doctor --json | jq -r '.[] | select(.subject == "cameras") | "\(.severity): \(.found); \(.remedy)"'; }
# begin ARGUMENTS…: capture alone on the camera, as the services' user, its log in $work/log.
begin() {
    $user semidense --instance "$rig" capture --source "v4l:$camera" --rig "$work/rig.toml" --log info "$@" > "$work/log" 2>&1 &
    job=$!
}
# finish: ends it in order; its exit code in CODE.
finish() {
    kill -INT "$job"
    wait "$job"
    CODE=$?
}

# The rigs of the other checks would take the time of this one.
was_active=$(systemctl is-active semidense@robot.target)
systemctl stop semidense@robot.target 2> /dev/null

set -- $(grep -v '^#' /host/sim/camera.txt)
printf 'model = "pinhole"\nwidth = %s\nheight = %s\nfx = %s\nfy = %s\ncx = %s\ncy = %s\n' "$5" "$6" "$1" "$2" "$3" "$4" > "$work/rig.toml"
width=$5 height=$6

# One camera (HDMI in) and what feeds it (HDMI out).
modprobe vivid n_devs=1 node_types=0x101 num_inputs=1 input_types=3 num_outputs=1 output_types=1
udevadm settle
within 20 $user test -r "$camera"
prepare_loop() {
    v4l2-ctl -d "$out" --set-dv-bt-timings index=0
    v4l2-ctl -d "$out" --set-fmt-video-out=width=640,height=480,pixelformat=GREY
    v4l2-ctl -d "$camera" --set-dv-bt-timings index=0
    control loop_video=1
    control osd_text_mode=2
} > /dev/null 2>&1
prepare_loop

echo "-- listed"
as_user cameras > "$work/cameras.txt" 2>&1
cat "$work/cameras.txt"
as_user cameras --json > "$work/cameras.json"
seen=$(jq -r '.[] | "\(.path) \(.card) (\(.driver)) \(.access), \(.formats | map(select(.usable).code) | join(" ")), \(.controls | length) controls"' "$work/cameras.json")
expect "cameras: the capture node and not the output" "$seen" test "$(jq length "$work/cameras.json")" = 1
expect "cameras: name of udev" "$(jq -r '.[0].names | join(" ")' "$work/cameras.json")" \
    sh -c "jq -e '.[0].names | index(\"platform-vivid.0-video-index0\")' $work/cameras.json"
expect "cameras: formats, sizes and controls" "$(grep -c 'format ' "$work/cameras.txt") formats" \
    sh -c "jq -e '.[0] | ([.formats[].code] | contains([\"GREY\", \"YUYV\", \"NV12\", \"Y16\"])) and (.controls | any(.name == \"Gain\"))' $work/cameras.json"

echo "-- refused"
seen=$(as_user run --source v4l:0 --output "$work/none" 2>&1)
expect "without a rig: one line that says so" "$seen" sh -c "echo '$seen' | grep -q -- '--rig FILE'"
sed 's/^width.*/width = 8000/' "$work/rig.toml" > "$work/odd.toml"
seen=$(timeout 60 $user semidense capture --instance odd --source v4l:0 --rig "$work/odd.toml" 2>&1)
code=$?
expect "a size that is not granted: an error with the sizes" "$code, $seen" sh -c "test $code = 1 && echo '$seen' | grep -q 'where 8000x'"

echo "-- states"
chmod 600 "$camera"
begin
soon "forbidden: a state with its reason" 30 capture_is stale
expect "forbidden: the remedy" "$(count cause)" sh -c "grep -q 'usermod -aG video' $work/log"
seen=$(doctor)
expect "doctor: forbidden" "$seen" sh -c "echo '$seen' | grep -q 'may not be opened'"
v4l2-ctl -d "$camera" --stream-mmap --stream-count=100000 > /dev/null 2>&1 &
thief=$!
sleep 1
chmod 660 "$camera"
soon "busy: a state with its reason" 30 says 'in use by another program'
seen=$(doctor)
expect "doctor: busy" "$seen" sh -c "echo '$seen' | grep -q 'in use'"
kill "$thief"
soon "free again: frames flow" 30 flows
seen=$(doctor)
expect "doctor: streaming for semidense itself" "$seen" sh -c "echo '$seen' | grep -q '$camera'"
expect "what was granted is logged" "$(grep -o "$camera: ${width}x.*" "$work/log" | head -n 1)" says "${width}x$height GREY"

echo "-- faults"
before=$(count refused)
for _ in 1 2 3; do control inject_v4l2_buf_flag_error=1; sleep 0.5; done
soon "damaged frames are counted" 20 counts refused $((before + 3))
control percentage_of_dropped_buffers=50
sleep 2
control percentage_of_dropped_buffers=0
expect "lost frames are counted" "$(count gaps) gaps" test "$(count gaps)" -gt 5
control inject_vidioc_qbuf_error=1
sleep 1
soon "a buffer that is refused: frames flow" 30 flows
expect "and the camera stayed open" "$(grep -c 'buffers$' "$work/log") openings" test "$(grep -c 'buffers$' "$work/log")" = 1
control inject_fatal_streaming_error=1
soon "a fatal fault of the stream: its reason" 30 says 'its driver reports a fault'
soon "and frames flow again" 30 flows
control inject_vidioc_streamon_error=1
control inject_vidioc_reqbufs_error=1
control inject_fatal_streaming_error=1
soon "a start that fails: its reason" 30 says 'its driver refuses'
soon "and frames flow again, later" 60 flows
control timestamp_source=1
soon "stamps at the start of the exposure: frames flow" 30 flows
control timestamp_source=0
# In force from the next start of the stream on.
control wrap_timestamp=1
control inject_fatal_streaming_error=1
soon "stamps of another clock: its notice" 30 says 'stamped as they arrive'
soon "and frames flow" 30 flows
control wrap_timestamp=0
control inject_fatal_streaming_error=1
sleep 1

echo "-- unplugged"
control disconnect=1
soon "disconnected: its reason" 30 says 'unplugged'
soon "and frames flow again when it is back" 60 flows
frames=$(count frames)
echo -n vivid.0 > /sys/bus/platform/drivers/vivid/unbind
soon "the node is gone: a state with its reason" 30 says "there is no camera"
expect "capture lives on" "$(status '.capture | "\(.state): \(.cause)"')" capture_is stale
echo -n vivid.0 > /sys/bus/platform/drivers/vivid/bind
udevadm settle
soon "plugged in again: frames flow" 60 flows
expect "and their number has gone on" "$frames before, $(count frames) now" test "$(count frames)" -gt "$frames"
finish
expect "capture ends in order" "exit code $CODE" test "$CODE" = 130
cp "$work/log" /host/camera-capture.log

echo "-- gain"
prepare_loop
begin --set capture.camera.gain=33
soon "a fixed gain: frames flow" 30 flows
gain=$(v4l2-ctl -d "$camera" -C gain,gain_automatic | tr '\n' ' ')
expect "and the camera has it" "$gain" sh -c "echo '$gain' | grep -q 'gain: 33.*gain_automatic: 0'"
finish

echo "-- trajectory"
prepare_loop
/host/camera_loop feed tum:/host/sim 4 2> /dev/null | v4l2-ctl -d "$out" --stream-out-mmap --stream-from=- > /dev/null 2>&1 &
feeder=$!
# One frame of five: emulation does not keep up with sixty a second.
control percentage_of_dropped_buffers=80
sleep 1
$user semidense --instance "$rig" run --source "v4l:platform-vivid.0" --rig "$work/rig.toml" --output "$work/run" --json \
    --set tracker.deadline_ms=2000 > "$work/summary.json" 2> "$work/log" &
job=$!
soon "run: frames flow" 60 flows
SEMIDENSE_INSTANCE="$rig" $user /host/camera_loop watch tum:/host/sim "$work/truth.txt" > "$work/watch.json" 2>&1 &
watcher=$!
soon "run: it tracks" 240 tracks
sleep 60
kill -INT "$watcher"
wait "$watcher"
finish
kill "$feeder"
cat "$work/watch.json"
expect "run ends in order" "exit code $CODE" test "$CODE" = 130
seen=$(jq -r '"\(.exact) of \(.exact + .unknown) frames, \(.repeated) of them repeated"' "$work/watch.json")
expect "every frame is a picture of the recording, pixel for pixel" "$seen" sh -c "jq -e '.unknown == 0 and .exact > 100' $work/watch.json"
semidense evaluate "$work/run/trajectory.txt" "$work/truth.txt" --json > "$work/evaluation.json" 2>&1
cat "$work/evaluation.json"
seen=$(jq -r '"ATE \(.ate_rmse_m * 1000 | floor) mm over \(.matched_poses) poses and \(.path_length_m) m"' "$work/evaluation.json")
expect "the trajectory is the simulator's" "$seen" sh -c "jq -e '.ate_rmse_m < 0.02' $work/evaluation.json"
mkdir -p /host/camera-run
cp -r "$work/run" "$work/log" "$work"/*.json "$work/truth.txt" /host/camera-run/
rmmod vivid
[ "$was_active" = active ] && systemctl start semidense@robot.target
