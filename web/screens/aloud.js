// What is said to the person: a button that names its sentence, the language that the person speaks, and all sentences.
// Loaded when somebody first goes where people are spoken to.

import { choose, close, closed, open, say } from "../aloud.js";
import { icon } from "../icons.js";
import { choice } from "../parts.js";
import { html, nothing } from "../vendor/lit-html.js";
import { has, languageName, LANGUAGES, t } from "../words.js";

const SENTENCES = ["still", "open", "light", "centre", "nerve", "again", "other", "rest", "finished"];

/** On Aim: what the person must do for this picture, and the way to everything else that can be said. */
export function toSay({ aloud, route }) {
  if (!aloud) return nothing;
  const field = route.slot.split("-")[1];
  const key = has(`say.${field}`) ? `say.${field}` : "say.still";
  return html`<div class="aloud">
    ${button(aloud, key, "say", t(key), inOwnWords(aloud, key))}
    <button type="button" id="say-more" aria-haspopup="dialog" @click=${open}>
      <span lang=${aloud.tag}>${LANGUAGES[aloud.tag].name}</span><small>${t("voice.more")}</small>
    </button>
  </div>`;
}

/** On Person: the question, asked in the person's language. */
export function toAsk({ aloud }) {
  if (!aloud) return nothing;
  return html`<div class="asking">
    ${button(aloud, "say.consent", "say", t("consent"), aloud.able ? inOwnWords(aloud, "say.consent") : noVoice(aloud))}
    ${languages(aloud)}
  </div>`;
}

/** Everything that can be said; and large, what nobody could hear. */
export function sheet({ aloud, saying }) {
  if (!aloud) return nothing;
  const { tag, words, able } = aloud;
  const why = saying?.why || (able ? "" : "voice.none");
  return html`<dialog id="aloud" aria-labelledby="aloud-title" aria-describedby="sentence" @close=${closed}>
    <h2 id="aloud-title">${t("voice.title")}</h2>
    ${why ? html`<p class="warning">${icon("warn")} ${t(why, { language: languageName(tag) })}</p>` : nothing}
    <p id="sentence" lang=${tag} ?hidden=${!saying}>${saying ? words[saying.key] : ""}</p>
    <button class="primary" type="button" autofocus @click=${close}>${t("menu.close")}</button>
    ${languages(aloud)}
    <div class="sentences">${SENTENCES.map((name) => each(aloud, `say.${name}`))}</div>
  </dialog>`;
}

const inOwnWords = ({ tag, words }, key) =>
  words[key] === t(key) ? nothing : html`<small lang=${tag}>${words[key]}</small>`;
const noVoice = ({ tag }) => html`<small>${t("voice.none", { language: languageName(tag) })}</small>`;
const each = (aloud, key) => button(aloud, key, nothing, t(key), inOwnWords(aloud, key));

function button({ able }, key, id, words, under) {
  return html`<button type="button" id=${id} data-say=${key} @click=${(event) => say(key, event)}>
    ${icon(able ? "loud" : "read")} <span>${t(able ? "voice.say" : "voice.read", { words })}${under}</span>
  </button>`;
}

const languages = ({ tag }) => html`
  <div class="speaks">
    <h3>${t("voice.language")}</h3>
    ${choice({
      label: t("voice.language"),
      field: "voice",
      value: tag,
      options: Object.entries(LANGUAGES).map(([one, { name }]) => [one, name]),
      choose,
    })}
    ${LANGUAGES[tag].draft ? html`<p class="muted">${t("voice.draft")}</p>` : nothing}
  </div>
`;
