"""Spectra of noise and tones by scipy.signal, for tests/suite/sound.rs: JSON on standard output."""

import json

import numpy
import scipy
import scipy.signal

random = numpy.random.default_rng(1)
cases = []
for rate, length in [(51_200.0, 2048), (48_000.0, 1024), (8_000.0, 256)]:
    hop = length // 4
    time = numpy.arange(length + 4 * hop) / rate
    samples = 0.1 * random.standard_normal(time.size)
    for frequency, amplitude in [(0.031 * rate, 1.0), (0.2 * rate, 0.01), (0.41 * rate, 5.0)]:
        samples += amplitude * numpy.sin(2 * numpy.pi * frequency * time)
    samples = samples.astype(numpy.float32)
    _, _, power = scipy.signal.spectrogram(
        samples.astype(float),
        rate,
        window="hann",
        nperseg=length,
        noverlap=length - hop,
        detrend=False,
        scaling="spectrum",
        mode="psd",
    )
    cases.append(
        {"length": length, "hop": hop, "samples": samples.astype(float).tolist(), "power": power.T.tolist()}
    )
print(json.dumps({"versions": f"scipy {scipy.__version__}, numpy {numpy.__version__}", "cases": cases}))
