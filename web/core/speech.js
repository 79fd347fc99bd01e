// Sentences for the patient, spoken in the patient's language, which may differ from the page's. Without a voice, the
// sentence is shown in large letters, to be read out.

import { get, saveSetting, set, store } from "./state.js";
import { onVoicesChanged, speakSentence, voiceFor } from "./speech_synthesis.js";
import { LANGUAGES, loadTexts } from "../i18n/translate.js";

const $ = (selector) => document.querySelector(selector);

/** Return the speech language: the one chosen on this tablet, else the page's. */
const speechLanguage = ({ voice, language }) => [voice, language, "en"].find((tag) => tag in LANGUAGES);

async function prepareSpeech() {
  const tag = speechLanguage(get());
  const words = await loadTexts(tag);
  if (tag === speechLanguage(get())) set({ speech: Object.freeze({ tag, words, hasVoice: voiceFor(tag) !== null }) });
}

/**
 * Speak a sentence. After a tap, move the focus to the shutter, so that a remote shutter key does not repeat the
 * sentence.
 */
export async function sayToPatient(key, event) {
  const { words, tag } = get().speech;
  if (event?.detail) $("#shutter")?.focus({ preventScroll: true });
  set({ saying: Object.freeze({ key, why: "" }) });
  const spoken = await speakSentence(words[key], tag);
  if (spoken || get().saying?.key !== key) return;
  set({ saying: Object.freeze({ key, why: get().speech.hasVoice ? "voice.failed" : "voice.none" }) });
  openDialog();
}

export const openDialog = () => $("#aloud").open || $("#aloud").showModal();
export const closeDialog = () => $("#aloud").close();
export const dialogClosed = () => set({ saying: null });

/** Store the speech language. */
export function chooseVoice(voice) {
  saveSetting("voice", voice);
  set({ voice, saying: null });
}

store.subscribe((state) => speechLanguage(state) !== state.speech?.tag && prepareSpeech());
onVoicesChanged(prepareSpeech);
prepareSpeech();
