#!/bin/bash
# Slurm: one run. Submit with: sbatch --ntasks 16 deploy/cluster/topspin.slurm.sh NAME
# Written by `python -m deploy.manifests`: change its tables, not this file.
#SBATCH --job-name=topspin
#SBATCH --ntasks=8
#SBATCH --cpus-per-task=1
#SBATCH --mem-per-cpu=2G
#SBATCH --time=24:00:00
#SBATCH --signal=B:TERM@120
#SBATCH --requeue
# Learner, evaluator and generators share the first node with its actors: ask for nodes with 4 cores more than
# actors. When the time is up, or the job is put back into the queue, the next one goes on where this one ended.
set -euo pipefail

run=${1:?usage: sbatch topspin.slurm.sh NAME}
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
python=${PYTHON:-python} # not TOPSPIN_...: those are settings
folder=runs/$run # on a file system that all nodes see
settings=$folder/slurm.toml
mkdir -p "$folder/logs"
cat >"$settings" <<END
run = "$run"
endpoint = "tcp/$(hostname):7447"
actors = $SLURM_NTASKS
generators = 1
metrics_host = "0.0.0.0"
END

workers=()
"$python" -m services.learner --config "$settings" --id 0 --metrics-port 9100 --auto-resume --endpoint "tcp/0.0.0.0:7447" >>"$folder/logs/learner-0.log" 2>&1 &
learner=$!
"$python" -m services.evaluator --config "$settings" --id 0 --metrics-port 9100 >>"$folder/logs/evaluator-0.log" 2>&1 &
workers+=($!)
"$python" -m services.generator --config "$settings" --id 0 --metrics-port 9100 --index 0 >>"$folder/logs/generator-0.log" 2>&1 &
workers+=($!)
# shellcheck disable=SC2016 # each task has its own number
srun --overlap --kill-on-bad-exit=0 --output="$folder/logs/actor-%t.log" \
    bash -c 'exec "$0" -m services.actor --config "$1" --id $SLURM_PROCID --metrics-port 9100 --index $SLURM_PROCID' "$python" "$settings" &
workers+=($!)

# The learner ends when its budget is spent; SIGTERM comes two minutes before the end of the job's time.
trap 'kill -TERM "$learner" 2>/dev/null || true' TERM INT
status=0
wait "$learner" || status=$?
while kill -0 "$learner" 2>/dev/null; do # a signal has ended the wait, not the learner
    status=0
    wait "$learner" || status=$?
done
kill -TERM "${workers[@]}" 2>/dev/null || true
wait "${workers[@]}" 2>/dev/null || true
exit "$status"
