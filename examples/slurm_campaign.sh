#!/bin/bash
# A campaign as a SLURM job array: 16 jobs that know nothing of each other, then one that sums up
# and computes what a failed job left out.
#
#   job=$(sbatch --parsable slurm_campaign.sh)
#   sbatch --dependency=afterany:$job --cpus-per-task=4 --mem-per-cpu=1G --time=02:00:00 \
#       --wrap "jaxslam consistency --resume $PWD/campaign"
#
#SBATCH --job-name=campaign
#SBATCH --array=1-16
#SBATCH --cpus-per-task=4
#SBATCH --mem-per-cpu=1G
#SBATCH --time=02:00:00
set -euo pipefail

# Every part needs the same options and the same number of devices (cores of the CPU).
# "$@": further options, as in sbatch slurm_campaign.sh --seed 1
exec jaxslam consistency --scenario cloister --filters ekf,right_invariant --runs 100000 \
    --devices "$SLURM_CPUS_PER_TASK" --out "$SLURM_SUBMIT_DIR/campaign" \
    --part "$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT" "$@"
