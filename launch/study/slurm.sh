#!/bin/sh
# A study as a Slurm array, and one table when all of it has ended:
#
#     jobs=$(sbatch --parsable --array=1-8 launch/study/slurm.sh study.toml results)
#     sbatch --dependency=afterok:$jobs --wrap "squealcast study merge results -o results.parquet"
#
# A job that was killed goes on where it was: submit it again.
#SBATCH --cpus-per-task=4
#SBATCH --requeue
exec squealcast study "$1" -o "$2" --shard "$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT" \
    --threads "${SLURM_CPUS_PER_TASK:-1}" --quiet
