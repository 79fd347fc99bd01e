// Templates of the sentences for the patient: speech buttons, language choice and dialog. Loaded with the first screen
// that needs them.

import { chooseVoice, closeDialog, dialogClosed, openDialog, sayToPatient } from "../core/speech.js";
import { icon } from "./icons.js";
import { choice } from "./components.js";
import { html, nothing } from "../vendor/lit-html.js";
import { has, languageName, LANGUAGES, t } from "../i18n/translate.js";

const SENTENCES = ["still", "open", "light", "centre", "nerve", "again", "other", "rest", "finished"];

/** On the aim screen: the instruction for this slot, and a button for all other sentences. */
export function speechButtons({ speech, route }) {
  if (!speech) return nothing;
  const field = route.slot.split("-")[1];
  const key = has(`say.${field}`) ? `say.${field}` : "say.still";
  return html`<div class="aloud">
    ${button(speech, key, "say", t(key), translatedText(speech, key))}
    <button type="button" id="say-more" aria-haspopup="dialog" @click=${openDialog}>
      <span lang=${speech.tag}>${LANGUAGES[speech.tag].name}</span><small>${t("voice.more")}</small>
    </button>
  </div>`;
}

/** On the patient screen: the consent question in the patient's language. */
export function consentQuestion({ speech }) {
  if (!speech) return nothing;
  return html`<div class="asking">
    ${button(speech, "say.consent", "say", t("voice.consent"), speech.hasVoice ? translatedText(speech, "say.consent") : noVoice(speech))}
    ${languages(speech)}
  </div>`;
}

/** Dialog with all sentences, and in large letters the one that was not spoken. */
export function speechDialog({ speech, saying }) {
  if (!speech) return nothing;
  const { tag, words, hasVoice } = speech;
  const why = saying?.why || (hasVoice ? "" : "voice.none");
  return html`<dialog id="aloud" aria-labelledby="aloud-title" aria-describedby="sentence" @close=${dialogClosed}>
    <h2 id="aloud-title">${t("voice.title")}</h2>
    ${why ? html`<p class="warning">${icon("warn")} ${t(why, { language: languageName(tag) })}</p>` : nothing}
    <p id="sentence" lang=${tag} ?hidden=${!saying}>${saying ? words[saying.key] : ""}</p>
    <button class="primary" type="button" autofocus @click=${closeDialog}>${t("menu.close")}</button>
    ${languages(speech)}
    <div class="sentences">${SENTENCES.map((name) => sentenceButton(speech, `say.${name}`))}</div>
  </dialog>`;
}

const translatedText = ({ tag, words }, key) =>
  words[key] === t(key) ? nothing : html`<small lang=${tag}>${words[key]}</small>`;
const noVoice = ({ tag }) => html`<small>${t("voice.none", { language: languageName(tag) })}</small>`;
const sentenceButton = (speech, key) => button(speech, key, nothing, t(key), translatedText(speech, key));

function button({ hasVoice }, key, id, words, under) {
  return html`<button type="button" id=${id} data-say=${key} @click=${(event) => sayToPatient(key, event)}>
    ${icon(hasVoice ? "loud" : "read")} <span>${t(hasVoice ? "voice.say" : "voice.read", { words })}${under}</span>
  </button>`;
}

const languages = ({ tag }) => html`
  <div class="speaks">
    <h3>${t("voice.language")}</h3>
    ${choice({
      label: t("voice.language"),
      field: "voice",
      value: tag,
      options: Object.entries(LANGUAGES).map(([language, { name }]) => [language, name]),
      choose: chooseVoice,
    })}
    ${LANGUAGES[tag].draft ? html`<p class="muted">${t("voice.draft")}</p>` : nothing}
  </div>
`;
