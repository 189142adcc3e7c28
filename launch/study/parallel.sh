#!/bin/sh
# A study in shards by GNU parallel, and one table in the end:
#
#     launch/study/parallel.sh study.toml results 8
#
# More hosts: PARALLEL="--sshloginfile hosts --workdir ." where all of them see this folder.
set -eu
study=$1 results=$2 shards=$3
# --will-cite: do not ask for a citation on a terminal.
seq "$shards" | parallel --will-cite --halt soon,fail=1 \
    squealcast study "$study" -o "$results" --shard "{}/$shards" --threads 1 --quiet
squealcast study merge "$results" -o "$results.parquet"
