# The package installs on a plain Debian, with all promised files.
. /host/guest/lib
rig=robot

cp /host/semidense.deb /tmp/
apt-get install -y -qq --no-install-recommends /tmp/semidense.deb 2>&1
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

cp -r /host/sim /var/lib/robot-sim
chmod -R a+rX /var/lib/robot-sim
cp /host/guest/robot.toml /etc/semidense/robot.toml
# An emulated CPU on a busy machine may delay a process for longer than a robot's watchdog allows.
for process in capture tracker mapper; do
    mkdir -p "/etc/systemd/system/semidense-$process@.service.d"
    printf '[Service]\nWatchdogSec=%s\n' "$([ $process = mapper ] && echo 60 || echo 12)" \
        > "/etc/systemd/system/semidense-$process@.service.d/emulated.conf"
done
systemctl daemon-reload
