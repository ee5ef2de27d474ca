# A hanging process (here: stopped) is killed by its watchdog and restarted; clean stopping.
. /host/guest/lib
rig=robot

for process in capture tracker mapper; do
    before=$(property "$process" NRestarts)
    kill -STOP "$(main_pid "$process")"
    soon "watchdog of $process" 180 has_restarted "$process" $((before + 1))
    expect "it was the watchdog" "$(journalctl --no-pager --boot -u "$(unit "$process")" | grep -c 'Watchdog timeout') in the journal" \
        sh -c "journalctl --no-pager --boot -u $(unit "$process") | grep -q 'Watchdog timeout'"
    soon "poses after it" 90 tracks
done

begin=$(now_ms)
systemctl stop semidense@robot.target
for process in capture tracker mapper; do
    expect "$process ends in order" "$(property "$process" Result), after $(($(now_ms) - begin)) ms" \
        test "$(property "$process" Result) $(property "$process" ActiveState)" = "success inactive"
done
left=$(leftovers)
expect "nothing is left when the last rig is stopped" "${left:-nothing}" test -z "$left"
systemctl start semidense@robot.target
soon "poses after stop and start" 240 tracks
