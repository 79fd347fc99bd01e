// Speech synthesis with the tablet's voices. Some voices need the internet, which is missing; the result reports
// whether speech began, so that the caller can show the text.

const START_TIMEOUT_MS = 3000; // a voice that has not started by then needs the internet
const RATE = 0.9;

const languageOf = (tag) => tag.toLowerCase().split(/[-_]/)[0];

/** Return a voice for a language such as "ta", a local one first; null if there is none. */
export function voiceFor(tag) {
  const voices = window.speechSynthesis?.getVoices() ?? [];
  const matching = voices.filter(({ lang }) => languageOf(lang) === languageOf(tag));
  return matching.find(({ localService }) => localService) ?? matching[0] ?? null;
}

/** Call `listener` when the list of voices changes; browsers load it after the page. */
export const onVoicesChanged = (listener, signal) => window.speechSynthesis?.addEventListener("voiceschanged", listener, { signal });

let current = null; // this reference also prevents garbage collection during speech

/**
 * Speak a sentence and stop the previous one. False if no speech started; true also if a newer sentence replaced it.
 */
export async function speakSentence(sentence, tag) {
  const voice = voiceFor(tag);
  if (!voice) return false;
  window.speechSynthesis.cancel();
  return new Promise((resolve) => {
    const utterance = new SpeechSynthesisUtterance(sentence);
    current = utterance;
    Object.assign(utterance, { voice, lang: voice.lang.replace("_", "-"), rate: RATE });
    const startTimer = setTimeout(() => {
      resolve(current !== utterance);
      if (current === utterance) window.speechSynthesis.cancel();
    }, START_TIMEOUT_MS);
    utterance.onstart = () => clearTimeout(startTimer);
    utterance.onend = () => resolve(true);
    utterance.onerror = ({ error }) => {
      clearTimeout(startTimer);
      resolve(error === "canceled" || error === "interrupted");
    };
    window.speechSynthesis.speak(utterance);
  });
}
