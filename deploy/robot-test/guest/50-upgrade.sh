# An upgrade keeps the user's configuration and restarts running rigs.
. /host/guest/lib
rig=robot

echo '# mine' >> /etc/semidense/webcam.toml
old=$(main_pid tracker)
DEBIAN_FRONTEND=noninteractive apt-get install -y -o Dpkg::Options::=--force-confdef -o Dpkg::Options::=--force-confold \
    /host/semidense-next.deb 2>&1
expect "upgraded" "version $(dpkg-query -W -f '${Version}' semidense)" \
    test "$(dpkg-query -W -f '${Version}' semidense)" = "$(dpkg-deb -f /host/semidense-next.deb Version)"
# Changed by both sides; changed only by the package.
expect "the user's configuration stays" "$(tail -n 1 /etc/semidense/webcam.toml)" grep -q '^# mine' /etc/semidense/webcam.toml
expect "the package's own is renewed" "$(tail -n 1 /etc/semidense/semidense.toml)" grep -q '^# next' /etc/semidense/semidense.toml
expect "a rig of the user's stays" "robot.toml" test -s /etc/semidense/robot.toml
new=$(main_pid tracker)
expect "the rig was restarted" "tracker was process $old, is $new" test "$new" != 0 -a "$new" != "$old"
soon "poses after the upgrade" 240 tracks
