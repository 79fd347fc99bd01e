// The page's whole memory: one plain object, and a list of those who want to hear about changes.

/**
 * @template {object} T
 * @param {T} initial
 */
export function createStore(initial) {
  let state = Object.freeze({ ...initial });
  let told = false;
  const listeners = new Set();

  const tell = () => {
    told = false;
    for (const listener of listeners) listener(state);
  };

  return {
    get: () => state,

    /** Change some values now, and tell the listeners once, after the current task: many changes make one render. */
    set(patch) {
      if (Object.keys(patch).every((key) => Object.is(patch[key], state[key]))) return;
      state = Object.freeze({ ...state, ...patch });
      if (!told) {
        told = true;
        queueMicrotask(tell);
      }
    },

    subscribe(listener) {
      listeners.add(listener);
      return () => listeners.delete(listener);
    },
  };
}
