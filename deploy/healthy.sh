#!/bin/sh
# Succeeds if every process of this container said within the last 3 s that it is well.
cd "${SACCADE_HEARTBEATS:-/tmp/heartbeats}" 2>/dev/null || exit 1
[ -n "$(ls)" ] || exit 1
[ -z "$(find . -type f ! -newermt '-3 seconds')" ] || exit 1
for file in *; do
    case $(cat "$file") in ready | busy | finished) ;; *) exit 1 ;; esac
done
