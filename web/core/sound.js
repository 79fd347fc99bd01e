// Tones from oscillators (no audio files); loaded with the first tone. Each tone has its own melody.

const NOTES = {
  ready: [[880, 0, 0.1]],
  taken: [[1320, 0, 0.05]],
  good: [[660, 0, 0.12], [990, 0.13, 0.22]], // rising
  poor: [[392, 0, 0.16], [262, 0.18, 0.3]], // falling
}; // [frequency in Hz, start, length]
const GAIN = 0.2;
const RAMP_S = 0.01; // amplitude ramp, which prevents clicks

let context = null;

/** Play a melody. Browsers stay silent before the first touch of the page. */
export function play(name) {
  context ??= new AudioContext();
  if (context.state === "suspended") context.resume();
  for (const [hz, begin_s, length_s] of NOTES[name]) note(hz, context.currentTime + begin_s, length_s);
}

function note(hz, at_s, length_s) {
  const tone = new OscillatorNode(context, { frequency: hz });
  const volume = new GainNode(context, { gain: 0 });
  volume.gain.setValueAtTime(0, at_s);
  volume.gain.linearRampToValueAtTime(GAIN, at_s + RAMP_S);
  volume.gain.setValueAtTime(GAIN, at_s + length_s - RAMP_S);
  volume.gain.linearRampToValueAtTime(0, at_s + length_s);
  tone.connect(volume).connect(context.destination);
  tone.start(at_s);
  tone.stop(at_s + length_s);
}
