// The user of this page: requests for the login, and the event "login-required" for the dialog that asks for it.

const LOGIN_CODES = ["access.none", "access.setup", "access.confirm"];
const ACTIVITY_MS = 30_000; // at most one activity report in this time
const NAMES = "diffuscope.names";
const MAX_NAMES = 6;

/** Set-up code in the address that the label shows; read before the router replaces the fragment. */
export const codeOfLabel = new URLSearchParams(location.hash.slice(1)).get("code") ?? "";

/**
 * Ask the user for a login if an answer of the server requires one; return whether it does.
 * @param {{code: string}} answer
 */
export function askIfRequired({ code }) {
  const isRequired = LOGIN_CODES.includes(code);
  if (isRequired) document.dispatchEvent(new CustomEvent("login-required", { detail: code }));
  return isRequired;
}

/**
 * Send a request for the login; return the answer, `{message, remedy}` of a refusal, or null without an answer.
 * @param {string} method
 * @param {string} [path]
 * @param {Record<string, any>} [body]
 */
export async function requestLogin(method, path = "/api/login", body = undefined) {
  /** @type {RequestInit} */
  const options = { method, cache: "no-store" };
  if (body) Object.assign(options, { headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
  const response = await fetch(path, options).catch(() => null);
  return response?.json().catch(() => null) ?? null;
}

/** Ask for a login if no user is signed in; return the user, or null. */
export async function checkLogin() {
  const login = await requestLogin("GET");
  if (login && !login.user) askIfRequired({ code: login.needs_setup ? "access.setup" : "access.none" });
  return login?.user ?? null;
}

/** Sign out, which locks this page until a user signs in. */
export async function lock() {
  await requestLogin("DELETE");
  await checkLogin();
}

/** Open the dialog in which the user changes the own PIN. */
export function changeSecret() {
  document.dispatchEvent(new CustomEvent("login-required", { detail: "own" }));
}

let activityMs = -ACTIVITY_MS;

/** Report that the user touches the page, which delays the idle lock; polling does not. */
export function reportActivity() {
  if (performance.now() - activityMs < ACTIVITY_MS) return;
  activityMs = performance.now();
  requestLogin("POST", "/api/login/activity");
}

/** Return the names that signed in on this screen, the latest first. */
export function knownNames() {
  try {
    return JSON.parse(localStorage.getItem(NAMES) ?? "[]").map(String);
  } catch {
    return [];
  }
}

/** Remember a name on this screen, so that users change with one tap and a PIN. */
export function rememberName(name) {
  const names = [name, ...knownNames().filter((known) => known !== name)].slice(0, MAX_NAMES);
  try {
    localStorage.setItem(NAMES, JSON.stringify(names));
  } catch (problem) {
    if (!(problem instanceof DOMException)) throw problem; // without storage, the name is typed each time
  }
}
