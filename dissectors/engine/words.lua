-- A message in a few words, for the packet list.

local MOST_WORDS, MOST_ITEMS = 8, 3  -- what fits in one line

local function text_value(step, s, p, count, big)
	if step.width == 1 then
		return utf8_text(s:sub(p, p + count - 2))
	end
	return wide_text(s, p, p + count * step.width - 1, step.width, big)
end

-- A primitive in a few characters.
local function short_value(leaf, value)
	local code = leaf.code
	if code == "d" or code == "f" then
		return value ~= value and "nan" or format("%.6g", value)
	elseif code == "?" then
		return value ~= 0 and "True" or "False"
	elseif leaf.size == 8 then
		return tostring(value)
	end
	return format("%d", value)
end

local function value_at(leaf, s, p, big)
	return (unpack(big and leaf.big or leaf.little, s, p))
end

local function listed(items, count)
	return "[" .. table.concat(items, ", ") .. (count > MOST_ITEMS and format(", ... %d", count) or "") .. "]"
end

local function short_numbers(leaf, s, p, count, big)
	local items = {}
	for index = 1, math.min(count, MOST_ITEMS) do
		items[index] = short_value(leaf, value_at(leaf, s, p + (index - 1) * leaf.size, big))
	end
	return listed(items, count)
end

local short_message

-- Append the words of a list of messages or texts; return where it ends.
local function short_list(step, s, p, start, big)
	local items, count = {}, step.count
	if not count then count, p = count_at(s, p, start, big) end
	if step.element and count > 0 then
		local leaf = step.steps[1].leaves[1]
		p = p + (start - p) % leaf.size
		return short_numbers(leaf, s, p, count, big), p + count * leaf.size
	end
	for index = 1, count do
		if index > MOST_ITEMS then
			p = check(step.steps, s, p, start, #s, big)
		elseif step.unnamed then
			local inner = step.steps[1]
			if inner.steps then
				items[index], p = short_list(inner, s, p, start, big)
				items[index] = items[index] or "[]"
			else
				local length
				length, p = count_at(s, p, start, big)
				items[index] = text_value(inner, s, p, length, big)
				p = p + length * inner.width
			end
		else
			local text
			text, p = short_message(step.steps, s, p, start, big, true)
			items[index] = "{" .. text .. "}"
		end
	end
	return count > 0 and listed(items, count) or nil, p
end

local words, header = {}, {}  -- of the message that is told; lists of messages have their own

local function say(name, value)
	local list = name:sub(1, 7) == "header." and header or words
	list[#list + 1] = name .. "=" .. value
end

-- Say the single values of a run, decoded at once where they can be. A zero is not said; -0.0 is one too.
local function say_run(run, s, p, big)
	local values = run.little and {unpack(big and run.big or run.little, s, p)}
	local leaves = run.leaves
	for index = 1, #leaves do
		local leaf = leaves[index]
		if leaf.count then
			say(leaf.name, short_numbers(leaf, s, p + leaf.offset, leaf.count, big))
		elseif not leaf.hidden then
			local value = values and values[index] or value_at(leaf, s, p + leaf.offset, big)
			if leaf.wide or value ~= value then
				value = short_value(leaf, value)
				if value ~= "0" then say(leaf.name, value) end
			elseif value ~= 0 then
				local list = leaf.in_header and header or words
				list[#list + 1] = format(leaf.form, value)
			end
		end
	end
end

-- Return a message in a few words: zeros left out, long arrays cut, the header last; and where it ends, which
-- is known only where `whole` is asked for.
function short_message(steps, s, p, start, big, whole)
	local outer_words, outer_header = words, header
	words, header = {}, {}
	for index = 1, #steps do
		local step = steps[index]
		if #words > MOST_WORDS and not whole then break end
		if step.leaves then
			p = p + (start - p) % step.alignment
			say_run(step, s, p, big)
			p = p + step.size
		elseif step.steps then
			local text
			text, p = short_list(step, s, p, start, big)
			if text then say(step.name, text) end
		else
			local length
			length, p = count_at(s, p, start, big)
			if length > (step.width == 1 and 1 or 0) then
				say(step.name, text_value(step, s, p, length, big))
			end
			p = p + length * step.width
		end
	end
	local told, total = words, #words
	for _, word in ipairs(header) do
		total = total + 1
		told[total] = word
	end
	words, header = outer_words, outer_header
	if total == 0 then return "all zero", p end
	if total <= MOST_WORDS then return table.concat(told, " "), p end
	return table.concat(told, " ", 1, MOST_WORDS) .. " ...", p
end

