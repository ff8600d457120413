#!/usr/bin/env bash
# Asks a running polscan for a scan, waits for it and fetches its cloud: curl and jq are all that is needed.
#
#   examples/scan.sh [URL] [FILE]        POLSCAN_TOKEN holds the token where the service asks for one
set -euo pipefail
url=${1:-http://127.0.0.1:8631}
file=${2:-cloud.ply}

headers=(-H 'Content-Type: application/json' -H "Idempotency-Key: \"$(cat /proc/sys/kernel/random/uuid)\"")
[ -z "${POLSCAN_TOKEN:-}" ] || headers+=(-H "Authorization: Bearer $POLSCAN_TOKEN")

# Sends a request; where it is refused, says why and ends.
ask() {
  local answer status
  answer=$(curl -sS "${headers[@]}" -w '\n%{http_code}' "$@")
  status=${answer##*$'\n'}
  answer=${answer%$'\n'*}
  if [ "$status" -ge 400 ]; then
    jq -r '"refused: \(.title): \(.detail)"' <<<"$answer" >&2
    exit 1
  fi
  printf '%s\n' "$answer"
}

# The object may move as soon as the frames are taken.
scan=$(ask -X POST "$url/v1/scans?wait=acquired" -d '{"label": "bench", "queue": true}')
href=$(jq -r .href <<<"$scan")
echo "acquired: $href"

scan=$(ask "$url$href?wait=done")
jq -r '"\(.state), verdict \(.verdict), \(.points) points"' <<<"$scan"
[ "$(jq -r .state <<<"$scan")" = done ] || { jq -r '.reasons[].message' <<<"$scan" >&2; exit 1; }

curl -sS --fail "${headers[@]}" -o "$file" "$url$href/cloud.ply"
echo "cloud: $file"
