# kill -9 of each service: it is restarted, the others continue, poses resume.
. /host/guest/lib
rig=robot

for process in capture tracker mapper; do
    before=$(property "$process" NRestarts)
    others=
    for other in capture tracker mapper; do
        [ "$other" = "$process" ] || others="$others $(main_pid "$other")"
    done
    victim=$(main_pid "$process")
    kill -9 "$victim"
    soon "$process is started again" 30 has_restarted "$process" $((before + 1))
    soon "$process is ready again" 30 is_active "$process"
    soon "poses after the death of $process" 120 tracks
    soon "$process works again" 60 frames_flow "$process"
    # shellcheck disable=SC2086
    expect "the others have not noticed" "processes$others" kill -0 $others
done

# A process that repeatedly dies at once is restarted with a growing delay.
before=$(property mapper NRestarts)
for _ in 1 2 3 4 5 6; do
    victim=$(main_pid mapper)
    [ "$victim" -gt 0 ] && kill -9 "$victim"
    within 15 is_active mapper
    begin=$TOOK
done
expect "back-off" "the sixth restart in a row took $begin ms" test "$begin" -gt 900
soon "and then it works" 60 frames_flow mapper
