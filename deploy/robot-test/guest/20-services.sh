# An enabled rig becomes ready on its own, with the scheduling declared by its units, and publishes poses.
. /host/guest/lib
rig=robot

systemctl enable semidense@robot.target 2>&1
systemctl start semidense@robot.target
for process in capture tracker mapper; do
    # Type=notify: active means that the process itself has reported it.
    soon "$process is ready" 60 is_active "$process"
    expect "$process says what it does" "$(property "$process" StatusText)" test -n "$(property "$process" StatusText)"
done
soon "poses flow" 240 tracks
seen=$(status_line)
pass "status" "$seen"

tracker=$(main_pid tracker)
expect "tracker runs as FIFO" "$(chrt -p "$tracker" | tr '\n' ' ')" sh -c "chrt -p $tracker | grep -q 'priority: 70'"
others=$(for task in /proc/"$tracker"/task/*; do chrt -p "${task##*/}"; done | grep -c SCHED_FIFO)
expect "only its frame loop" "$others of its $(ls /proc/"$tracker"/task | wc -l) threads are FIFO" test "$others" = 1
expect "tracker's memory is locked" "$(grep VmLck /proc/"$tracker"/status | tr -s '\t ' ' ')" \
    sh -c "grep VmLck /proc/$tracker/status | grep -qv ' 0 kB'"
# A single check on an emulated machine may fall between two reports of the tracker.
for look in 1 2 3 4 5 6; do
    seen=$(status '.tracker | "\(.scheduling) \(.priority), memory locked: \(.memory_locked)"')
    case $seen in *null*) sleep 2 ;; *) break ;; esac
done
expect "tracker says so itself" "$seen" test "$seen" = "fifo 70, memory locked: true"
seen=$(status '[.capture, .tracker, .mapper] | map(.warning // "") | join("")')
expect "nothing was refused" "${seen:-no warning}" test -z "$seen"

for process in capture tracker mapper; do
    exposure=$(systemd-analyze security --no-pager "$(unit "$process")" 2> /dev/null | sed -n 's/.*: \([0-9.]*\) .*/\1/p' | tail -n 1)
    expect "exposure of $process" "$exposure of 10" awk "BEGIN {exit !($exposure > 0 && $exposure < 2)}"
done

# The watchdog of the package, before this test extended it for emulation.
for process in capture tracker mapper; do
    file=/usr/lib/systemd/system/semidense-$process@.service
    expect "watchdog of $process" "$(grep WatchdogSec "$file"), here $(property "$process" WatchdogUSec)" \
        test "$(property "$process" WatchdogUSec)" != 0
done

# The example of a dedicated CPU for the tracker.
mkdir -p /etc/systemd/system/semidense-tracker@robot.service.d
cp /usr/share/doc/semidense/examples/cpus.conf /etc/systemd/system/semidense-tracker@robot.service.d/
systemctl daemon-reload
systemctl restart "$(unit tracker)"
expect "CPUAffinity" "$(taskset -cp "$(main_pid tracker)")" sh -c "taskset -cp $(main_pid tracker) | grep -q ': 1$'"
soon "poses after a restart by hand" 120 tracks

# The mapper alone: the next one continues the map, from the checkpoint.
systemctl stop "$(unit mapper)"
expect "a stopped mapper leaves its map" "$(ls /run/semidense)" test -e "/run/semidense/$rig.checkpoint"
systemctl start "$(unit mapper)"
soon "the next one maps" 120 maps

# A second rig alongside the first.
sed 's/:3:/:2:/' /etc/semidense/robot.toml > /etc/semidense/other.toml
rig=other
systemctl start semidense@other.target
soon "a second rig gives poses" 300 tracks
systemctl stop semidense@other.target
rig=robot
soon "the first continues" 30 tracks
