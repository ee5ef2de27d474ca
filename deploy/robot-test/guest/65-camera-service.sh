# A rig with a camera under systemd: ready without it, streams once it appears, and survives its failures.
. /host/guest/camera

cp "$work/rig.toml" /etc/semidense/camera-rig.toml
printf '[capture]\nsource = "v4l:%s"\nrig = "/etc/semidense/camera-rig.toml"\n' "$camera" > /etc/semidense/camera.toml
chmod 644 /etc/semidense/camera*.toml
journal_says() { journalctl --no-pager --boot -u "$(unit capture)" | grep -q "$1"; }

echo -n vivid.0 > /sys/bus/platform/drivers/vivid/unbind
systemctl start semidense@camera.target
soon "capture is ready without its camera" 60 is_active capture
soon "and says why there are no frames" 30 sh -c "systemctl show --property StatusText $(unit capture) | grep -q 'there is no camera'"
pass "status line" "$(property capture StatusText)"
echo -n vivid.0 > /sys/bus/platform/drivers/vivid/bind
udevadm settle
soon "the camera comes: frames flow" 60 frames_flow capture
before=$(property capture NRestarts)
control inject_fatal_streaming_error=1
soon "a fault of its driver is in the journal" 30 journal_says 'its driver reports a fault'
soon "and frames flow again" 60 frames_flow capture
control disconnect=1
soon "unplugged is in the journal" 30 journal_says 'unplugged'
soon "and frames flow again when it is back" 60 frames_flow capture
expect "all that without a restart" "$(property capture NRestarts) restarts" test "$(property capture NRestarts)" = "$before"
kill -9 "$(main_pid capture)"
soon "killed, it is started again" 30 has_restarted capture $((before + 1))
soon "and frames flow from the same camera" 60 frames_flow capture
systemctl stop semidense@camera.target
expect "capture ends in order" "$(property capture Result)" test "$(property capture Result)" = success
rm /etc/semidense/camera.toml /etc/semidense/camera-rig.toml
end_camera
