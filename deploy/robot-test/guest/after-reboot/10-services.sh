# The enabled rig has started again on its own.
. /host/guest/lib
rig=robot

soon "rig is active after the boot" 60 systemctl is-active --quiet semidense@robot.target
soon "poses after the boot" 240 tracks
pass "since the boot" "$(cut -d. -f1 /proc/uptime) s"
