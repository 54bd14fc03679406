// Questions to the server that gave the page; there is no other that is asked.

export async function get(path) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

// What the server answers to a value; an Error with its words where it refuses it, and with what it says of it besides.
export async function post(path, value) {
  const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(value) });
  if (answer.ok) return answer.json();
  const type = answer.headers.get("Content-Type");
  const said = type === "application/json" ? await answer.json() : { text: await answer.text() };
  throw Object.assign(new Error(said.text), { status: answer.status, said });
}

// Asks again and again for the newest value only: while one answer is awaited, values in between are left out. `answered` is
// told the answer and the value that was asked.
export function newest(path, answered, failed) {
  let waiting = null;
  let asking = false;
  return async function ask(value) {
    waiting = value;
    if (asking) return;
    asking = true;
    while (waiting !== null) {
      const asked = waiting;
      waiting = null;
      try {
        const answer = await post(path, asked);
        if (waiting === null) answered(answer, asked);
      } catch (error) {
        if (waiting === null) failed(error);
      }
    }
    asking = false;
  };
}
