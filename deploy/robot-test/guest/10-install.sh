# The package installs on a plain Debian, with everything that it promises.
. /host/guest/lib
rig=robot

cp /host/semidense.deb /tmp/
apt-get install -y --no-install-recommends /tmp/semidense.deb 2>&1
expect "apt install" "version $(dpkg-query -W -f '${Version}' semidense)" test "$(dpkg-query -W -f '${Status}' semidense)" = "install ok installed"
expect "the binary runs" "$(semidense --version)" semidense --version
expect "user semidense, in group video" "$(id semidense)" sh -c 'id -nG semidense | grep -qw video'
expect "runtime folder" "$(stat -c '%a %U' /run/semidense)" test "$(stat -c '%a %U' /run/semidense)" = "700 semidense"
expect "nothing runs before a rig is enabled" "$(systemctl list-units --plain --no-legend 'semidense-*' | wc -l) units" \
    test -z "$(systemctl list-units --plain --no-legend 'semidense-*')"
problems=$(systemd-analyze verify --man=no semidense@robot.target semidense-capture@robot.service \
    semidense-tracker@robot.service semidense-mapper@robot.service 2>&1 | grep semidense)
expect "units are well formed" "${problems:-no complaint}" test -z "$problems"
expect "shell completion" "bash" test -s /usr/share/bash-completion/completions/semidense

# A configuration that the user has changed stays through an upgrade (here: the same version again).
echo '# mine' >> /etc/semidense/webcam.toml
apt-get install -y --reinstall /tmp/semidense.deb 2>&1
expect "a changed configuration stays" "$(tail -n 1 /etc/semidense/webcam.toml)" grep -q '# mine' /etc/semidense/webcam.toml

# The rig of the next checks: a simulated recording, to and fro, as fast as emulation keeps up with.
cp -r /host/sim /var/lib/robot-sim
chmod -R a+rX /var/lib/robot-sim
cat > /etc/semidense/robot.toml <<'CONFIG'
[capture]
source = "loop:100000:10:tum:/var/lib/robot-sim"
CONFIG
