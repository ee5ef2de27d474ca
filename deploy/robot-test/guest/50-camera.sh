# A camera of a real driver (vivid): listed, opened, forbidden, busy, damaged, unplugged.
. /host/guest/camera

echo "-- listed"
# -s: without it, jq -e succeeds on an empty file.
as_user cameras > "$work/cameras.txt" 2>&1
cat "$work/cameras.txt"
as_user cameras --json > "$work/cameras.json"
seen=$(jq -r '.[] | "\(.path) \(.card) (\(.driver)) \(.access), \(.formats | map(select(.usable).code) | join(" ")), \(.controls | length) controls"' "$work/cameras.json")
expect "cameras: the capture node and not the output" "$seen" test "$(jq length "$work/cameras.json")" = 1
expect "cameras: name of udev" "$(jq -r '.[0].names | join(" ")' "$work/cameras.json")" \
    sh -c "jq -es '.[0][0].names | index(\"platform-vivid.0-video-index0\")' $work/cameras.json"
expect "cameras: formats, sizes and controls" "$(grep -c 'format ' "$work/cameras.txt") formats" \
    sh -c "jq -es '.[0][0] | ([.formats[].code] | contains([\"GREY\", \"YUYV\", \"NV12\", \"Y16\"])) and (.controls | any(.name == \"Gain\"))' $work/cameras.json"

echo "-- refused"
seen=$(as_user run --source v4l:0 --output "$work/none" 2>&1)
expect "without a rig: one line that says so" "$seen" sh -c "echo '$seen' | grep -q -- '--rig FILE'"
for one in scaler cropping composing; do control enable_capture_$one=0; done
seen=$(timeout 60 $user semidense capture --instance odd --source v4l:0 --rig "$work/rig.toml" 2>&1)
code=$?
expect "a size that is not granted: an error with the sizes" "$code, $seen" sh -c "test $code = 1 && echo '$seen' | grep -q 'delivers 640x480 .* instead of ${width}x'"
for one in scaler cropping composing; do control enable_capture_$one=1; done

echo "-- states"
chmod 600 "$camera"
begin
soon "forbidden: a state with its reason" 30 capture_is stale
expect "forbidden: the remedy" "$(count cause)" sh -c "grep -q 'usermod -aG video' $work/log"
seen=$(doctor)
expect "doctor: forbidden" "$seen" sh -c "echo '$seen' | grep -q 'has no permission to open it'"
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
soon "a start that fails: its reason" 30 says 'its driver refused the request'
soon "and frames flow again, later" 60 flows
control timestamp_source=1
soon "stamps at the start of the exposure: frames flow" 30 flows
control timestamp_source=0
# Takes effect from the next start of the stream.
control wrap_timestamp=1
control inject_fatal_streaming_error=1
soon "stamps of another clock: its notice" 30 says 'stamped as they arrive'
soon "and frames flow" 30 flows
control wrap_timestamp=0
control inject_fatal_streaming_error=1
# Noticed within a frame; reopened up to two seconds later. A camera that is not open cannot be unplugged.
sleep 1
soon "stamps of our own clock again: frames flow" 30 flows

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
end_camera
