// A sentence spoken by a voice of this tablet. Only the tablet knows which voices it has, and some of them need the
// internet, which is not there: whoever asks is told when nothing was heard, so that it can be read out instead.

const BEGIN_MS = 3000; // a voice that has not begun by then is waiting for the internet
const SLOWLY = 0.9;

const languageOf = (tag) => tag.toLowerCase().split(/[-_]/)[0];

/** A voice for a language such as "ta", one on the tablet itself before one from the internet; null where there is none. */
export function voiceFor(tag) {
  const voices = window.speechSynthesis?.getVoices() ?? [];
  const speaking = voices.filter(({ lang }) => languageOf(lang) === languageOf(tag));
  return speaking.find(({ localService }) => localService) ?? speaking[0] ?? null;
}

/** Call `then` whenever the tablet has found more voices: browsers look for them after the page is there. */
export const onVoices = (then, signal) => window.speechSynthesis?.addEventListener("voiceschanged", then, { signal });

let current = null; // also keeps the sentence from being forgotten by the browser while it is spoken

/** Speak a sentence, and end the one before it. False if nobody could hear it; true also when a newer one took its place. */
export async function speak(sentence, tag) {
  const voice = voiceFor(tag);
  if (!voice) return false;
  window.speechSynthesis.cancel();
  return new Promise((resolve) => {
    const words = new SpeechSynthesisUtterance(sentence);
    current = words;
    Object.assign(words, { voice, lang: voice.lang.replace("_", "-"), rate: SLOWLY });
    const silent = setTimeout(() => {
      resolve(current !== words);
      if (current === words) window.speechSynthesis.cancel();
    }, BEGIN_MS);
    words.onstart = () => clearTimeout(silent);
    words.onend = () => resolve(true);
    words.onerror = ({ error }) => {
      clearTimeout(silent);
      resolve(error === "canceled" || error === "interrupted");
    };
    window.speechSynthesis.speak(words);
  });
}
