# A camera assigned to a rig has a stable name and starts its rig when it is plugged in (here: the kernel's virtual
# camera, whose module serves as the plug).
. /host/guest/lib
rig=plugged

cat > /etc/udev/rules.d/65-cameras.rules <<'RULES'
SUBSYSTEM=="video4linux", ATTR{name}=="vivid-000-vid-cap", ENV{SEMIDENSE_RIG}="plugged"
RULES
cp /etc/semidense/robot.toml /etc/semidense/plugged.toml
udevadm control --reload
expect "not there before" "$(systemctl is-active semidense@plugged.target)" test ! -e /dev/semidense/plugged
modprobe vivid n_devs=1 node_types=0x101
soon "stable name" 30 test -c /dev/semidense/plugged
pass "it is" "$(readlink -f /dev/semidense/plugged), $(cat "/sys/class/video4linux/$(basename "$(readlink -f /dev/semidense/plugged)")/name")"
expect "the camera's own node alone has it" "$(find /dev/semidense -type l | wc -l) of $(find /dev -name 'video[0-9]*' | wc -l) nodes" \
    test "$(find /dev/semidense -type l | wc -l)" = 1
soon "the rig starts with its camera" 30 systemctl is-active --quiet semidense@plugged.target
soon "and gets ready" 60 is_active capture
systemctl stop semidense@plugged.target
modprobe -r vivid
soon "unplugged" 10 test ! -e /dev/semidense/plugged
rm /etc/udev/rules.d/65-cameras.rules /etc/semidense/plugged.toml
udevadm control --reload
