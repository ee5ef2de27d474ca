# apt purge, with a rig running, leaves nothing.
. /host/guest/lib
rig=robot

apt-get purge -y semidense 2>&1
expect "purged" "$(dpkg-query -W -f '${Status}' semidense 2>&1)" sh -c '! dpkg-query -W semidense 2> /dev/null'
expect "no process" "$(pgrep -c semidense)" sh -c '! pgrep semidense'
left=$(leftovers)
expect "no shared memory, no runtime folder" "${left:-nothing}" test -z "$left" -a ! -e /run/semidense
left=$(find / -xdev \( -path /host -o -path /proc -o -path /sys -o -path /tmp -o -path /var/lib/robot-sim -o -path /var/log \) -prune \
    -o -name '*semidense*' -print)
expect "no file" "${left:-nothing}" test -z "$left"
expect "no user, no group" "$(getent passwd semidense; getent group semidense)" sh -c '! getent passwd semidense && ! getent group semidense'
left=$(systemctl list-units --all --plain --no-legend '*semidense*')
expect "no unit" "${left:-none}" test -z "$left"
