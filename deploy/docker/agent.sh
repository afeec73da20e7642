#!/bin/sh
# Process 1 of the agent's container; its arguments go to `pup-agent run`.
#
# A container ends with its process 1, and all its processes with it: also the watchdog, which has to
# outlive a killed agent until the robot is limp. So this one stays until torque is off.
pup-agent run "$@" &
agent=$!
trap 'kill -TERM "$agent"' TERM INT
wait "$agent"
code=$?
while kill -0 "$agent" 2>/dev/null; do # a signal ended the wait, not the agent
    wait "$agent"
    code=$?
done
[ "$code" -eq 2 ] && exit 2 # the configuration has a mistake: nothing was opened
tries=0
until pup-agent disable "$@"; do
    tries=$((tries + 1))
    [ "$tries" -ge 20 ] && break
    sleep 0.2 # while the watchdog has the bus
done
exit "$code"
