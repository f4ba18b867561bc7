#!/usr/bin/env bash
# A study on several nodes of a SLURM cluster, one Ray node on each; after a time limit or a lost node it goes on:
#   sbatch slurm.sh STUDY.toml DATA RUN [--storage URL]
# with all of them on storage that the nodes share, and the environment active.
#SBATCH --job-name=cconv
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=16
#SBATCH --time=12:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
set -euo pipefail

study=$1 data=$2 run=$3
shift 3
export RAY_AUTH_MODE=token RAY_USAGE_STATS_ENABLED=0
export RAY_AUTH_TOKEN_PATH="$HOME/.ray/cconv_$SLURM_JOB_ID" # a token of this job; homes are shared
(umask 077 && mkdir -p "$HOME/.ray" && od -An -N32 -tx1 /dev/urandom | tr -d ' \n' > "$RAY_AUTH_TOKEN_PATH")
node="--block --num-cpus=$SLURM_CPUS_PER_TASK --disable-usage-stats"
address="$(hostname --ip-address | cut -d' ' -f1):$((20000 + SLURM_JOB_ID % 10000))"
trap 'kill $(jobs -p); rm -f "$RAY_AUTH_TOKEN_PATH"' EXIT

# This script runs on the first node: the head of the cluster, where the study is driven from.
ray start --head --node-ip-address="${address%:*}" --port="${address#*:}" --include-dashboard=false $node &
joined() { ray status --address="$address" 2> /dev/null | grep -c ' node_' || true; }
until (($(joined) >= 1)); do sleep 2; done
if ((SLURM_JOB_NUM_NODES > 1)); then
    srun --nodes=$((SLURM_JOB_NUM_NODES - 1)) --ntasks-per-node=1 --exclude="$SLURMD_NODENAME" \
        ray start --address="$address" $node &
fi
until (($(joined) >= SLURM_JOB_NUM_NODES)); do sleep 2; done # a stage uses the nodes that it finds when it begins

if [[ -f $run/study.json ]]; then
    cconv study resume "$run" --address "$address" "$@"
else
    cconv study run "$study" --data "$data" --out "$run" --address "$address" "$@"
fi
