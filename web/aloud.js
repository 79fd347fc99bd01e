// Speaking to the person in front of the camera, in the person's own language, whatever language the screen has. Where no
// voice is heard the sentence stands large on the screen, to be read out: it is never just silent.

import { get, remember, set, store } from "./memory.js";
import { onVoices, speak, voiceFor } from "./voice.js";
import { LANGUAGES, tableOf } from "./words.js";

const $ = (selector) => document.querySelector(selector);

/** What the person speaks: as chosen on this tablet, else what the screen speaks. */
const spoken = ({ voice, language }) => [voice, language, "en"].find((tag) => tag in LANGUAGES);

async function prepare() {
  const tag = spoken(get());
  const words = await tableOf(tag);
  if (tag === spoken(get())) set({ aloud: Object.freeze({ tag, words, able: voiceFor(tag) !== null }) });
}

/** Say one of the sentences. A finger gives the keyboard back to the shutter: a remote's press must not say it again. */
export async function say(key, event) {
  const { words, tag } = get().aloud;
  if (event?.detail) $("#shutter")?.focus({ preventScroll: true });
  set({ saying: Object.freeze({ key, why: "" }) });
  const heard = await speak(words[key], tag);
  if (heard || get().saying?.key !== key) return;
  set({ saying: Object.freeze({ key, why: get().aloud.able ? "voice.failed" : "voice.none" }) });
  open();
}

export const open = () => $("#aloud").open || $("#aloud").showModal();
export const close = () => $("#aloud").close();
export const closed = () => set({ saying: null });

export function choose(voice) {
  remember("voice", voice);
  set({ voice, saying: null });
}

store.subscribe((state) => spoken(state) !== state.aloud?.tag && prepare());
onVoices(prepare);
prepare();
